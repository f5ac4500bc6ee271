"""Values gone wrong, on purpose and reproducibly."""

import random

ODD_TEXTS = (
    *("", " ", "\0", "\x1b[2J", "\n", "..", "/", "a" * 2000, "ü", "\u2028", "%s", "nan", "-1"),
    *("é\u0301", "\ufeff", "../../x", "~", "$(x)", "{}", "None", "1e400", "0x10"),
)


class Chaos:
    """Changes values with a drawn probability; the same seed makes the same changes."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.choice = self.random.choice
        self.rate = self.choice([0.0, 0.0003, 0.001, 0.004, 0.02, 0.1])

    def hits(self, factor=1.0):
        """Whether to change something now."""
        return self.random.random() < self.rate * factor

    def number(self, value, bits):
        """An unsigned integer of so many bits."""
        if not self.hits():
            return value
        largest = (1 << bits) - 1
        odd = [0, 1, value + 1, value - 1, 2 * value, largest, largest >> 1, (largest >> 1) + 1]
        return self.choice([*odd, self.random.getrandbits(bits)]) & largest

    def real(self, value):
        """A floating-point number."""
        if not self.hits():
            return value
        odd = (0.0, -value, 1e154, -1e300, 1e9, 5e-324, float("nan"), float("inf"), 2 * value)
        return self.choice(odd)

    def text(self, value):
        """A text."""
        return self.choice(ODD_TEXTS) if self.hits() else value

    def data(self, value):
        """Bytes: cut off, extended, repeated, or with flipped bits."""
        if not self.hits() or not value:
            return value
        kind, place = self.random.randrange(5), self.random.randrange(len(value))
        if kind == 0:
            return value[:place]
        if kind == 1:
            return value + bytes(self.choice([1, 100, 100_000]))
        if kind == 2:
            return value * 2
        return self.flipped(value, self.choice([1, 3, 30]))

    def flipped(self, value, count):
        """Bytes with so many flipped bits."""
        changed = bytearray(value)
        for _ in range(count if value else 0):
            changed[self.random.randrange(len(changed))] ^= 1 << self.random.randrange(8)
        return bytes(changed)

    def items(self, values):
        """A list: some left out, repeated or exchanged."""
        values = list(values)
        if self.hits(2) and values:
            values.pop(self.random.randrange(len(values)))
        if self.hits(2) and values:
            values += [self.choice(values)] * self.choice([1, 2, 50])
        if self.hits(2):
            self.random.shuffle(values)
        return values
