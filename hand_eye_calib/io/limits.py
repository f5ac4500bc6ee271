"""Limits of what is read from files.

A file is never believed about its own size: what is larger than these limits is refused before
memory is allocated for it. Reading a bag takes at most 64 MB plus four times
:data:`LARGEST_MESSAGE`, whatever the file claims; the poses that are kept come on top.
"""

_MIB = 1 << 20

# ---- bags

#: Bytes of one message of a topic that is read, after decompression.
LARGEST_MESSAGE = 32 * _MIB
#: Bytes of one chunk that is read whole, before and after decompression.
LARGEST_CHUNK = 64 * _MIB
#: Messages in one chunk.
MOST_MESSAGES_PER_CHUNK = 250_000
#: Chunks in one file.
MOST_CHUNKS = 1_000_000
#: Channels or connections in one file.
MOST_TOPICS = 10_000
#: Storage files of one bag.
MOST_BAG_FILES = 1_000
#: Bytes of messages that wait because chunks overlap in time.
LARGEST_OVERLAP = 16 * _MIB
#: Bytes that a file may unpack to: this much ...
SMALLEST_UNPACKED = 64 * _MIB
#: ... plus this many times its own size.
LARGEST_RATIO = 256
#: Bytes of the name of a topic, a type or a frame.
LONGEST_NAME = 1_024
#: Frames in the transform tree of a bag.
MOST_FRAMES = 10_000
#: Bytes of a record that describes a topic or a schema.
LARGEST_DESCRIPTION = 4 * _MIB
#: A block of messages is passed on when it has reached this many bytes.
BLOCK_BYTES = 4 * _MIB

# ---- YAML

#: Bytes of a YAML file.
LARGEST_YAML = 1 * _MIB
#: Levels of nesting.
DEEPEST_YAML = 32
#: Values of a YAML file, with aliases and merge keys expanded.
MOST_YAML_VALUES = 100_000
#: Characters of a number; integers must also fit into 64 bits.
LONGEST_NUMBER = 64

# ---- trajectory files

#: Bytes of a trajectory file.
LARGEST_TEXT = 512 * _MIB
#: Characters of one line.
LONGEST_LINE = 65_536
#: Columns of a csv file.
MOST_COLUMNS = 1_000

# ---- session journal

#: Bytes of one record of a session journal.
LARGEST_RECORD = 1 << 30
#: Bytes of one file of a session journal.
LARGEST_SEGMENT = LARGEST_RECORD + 64 * _MIB
