"""Decode messages into objects through libraries.

This works for every type whose definition is in the bag. For frequent types, unpacking the bytes is
faster (``messages.py``).
"""

import json
from collections.abc import Callable
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Any

from hand_eye_calib.core.base.errors import (
    HandEyeCalibError,
    InputError,
    required,
)
from hand_eye_calib.formats.bags.storage import MessageKind


@lru_cache
def decoder_of(kind: MessageKind) -> Callable[[bytes], Any]:
    """Return the function that decodes the bytes of a message into an object.

    Raises
    ------
    InputError
        If the encoding or the definition of the messages is unknown.
    """
    if kind.encoding == "json":

        def object_of(fields: dict[str, Any]) -> SimpleNamespace:
            return SimpleNamespace(**fields)

        return partial(json.loads, object_hook=object_of)
    if kind.encoding not in ("cdr", "ros1", "protobuf"):
        raise InputError(
            f"messages of type {kind.type} have the encoding "
            f"{kind.encoding[:40]!r}; expected cdr, ros1, json or protobuf"
        )
    make_decoder = (
        _protobuf_decoder if kind.encoding == "protobuf" else _rosbags_decoder
    )
    try:
        return make_decoder(kind)
    except HandEyeCalibError:
        raise
    except Exception as error:  # damaged definitions raise errors of many kinds
        raise InputError(
            f"the bag contains no readable definition of {kind.type}; record "
            "again as mcap, which stores the definitions of all types"
        ) from error


def _protobuf_decoder(kind: MessageKind) -> Any:
    """Return the function that decodes messages in protobuf."""
    language, content = kind.definition
    mcap_protobuf = required("mcap_protobuf.decoder", kind.type, "foxglove")
    schema = SimpleNamespace(
        id=0, name=kind.type, encoding=language, data=content
    )
    return mcap_protobuf.DecoderFactory().decoder_for(kind.encoding, schema)


def _rosbags_decoder(kind: MessageKind) -> Callable[[bytes], Any]:
    """Return the function that decodes messages of ROS 1 or ROS 2."""
    from rosbags.typesys import (
        Stores,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    typestore = get_typestore(
        Stores.ROS1_NOETIC if kind.is_ros1 else Stores.ROS2_JAZZY
    )
    language, content = kind.definition
    if content and kind.type not in typestore.types:
        text = content.decode()
        if "idl" in language.lower():
            defined = get_types_from_idl(text)
        else:
            defined = get_types_from_msg(text, kind.type)
        new_names = defined.keys() - typestore.types.keys()
        typestore.register({name: defined[name] for name in new_names})
    typestore.types[kind.type]  # raises KeyError if the type is not defined
    decode = (
        typestore.deserialize_ros1
        if kind.is_ros1
        else typestore.deserialize_cdr
    )
    return lambda data: decode(data, kind.type)
