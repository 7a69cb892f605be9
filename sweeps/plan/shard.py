"""One of N shares of a sweep, for machines that share nothing but, perhaps, a folder."""

import re
from dataclasses import dataclass
from pathlib import Path

from sweeps.spec.mistakes import SweepError, printable

MOST = 10_000  # shards: a merged store has a line of 200 bytes for each in its attributes
_WRITTEN = re.compile(r"(\d{1,5})/(\d{1,5})", re.ASCII)


# How blocks are divided; a part records it, and a change of it needs another name here.
RULE = "golden"
_GOLDEN = 0x9E3779B97F4A7C15  # 2^64 divided by the golden ratio


@dataclass(frozen=True)
class Shard:
    """Share `k` of `n`, counted from 1: one block of each `n` consecutive ones.

    Consecutive blocks cost about the same. Which one of them it is changes from group to group, by
    the golden ratio: with the same one, a shard of as many as an axis has blocks would have one
    value of that axis, and shards would take 3 times as long as others. The last group may be
    incomplete, and have none.
    """

    k: int
    n: int

    def __str__(self) -> str:
        return f"{self.k}/{self.n}"

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """The shard of a text such as "3/40". Raises SweepError if it is none."""
        match = _WRITTEN.fullmatch(text)
        if match is None or not 1 <= int(match[1]) <= int(match[2]) <= MOST:
            wanted = f"K/N with whole numbers 1 <= K <= N <= {MOST:,}, as in 3/40"
            raise SweepError(f"--shard {printable(text)}: must be {wanted}")
        return cls(int(match[1]), int(match[2]))

    def blocks(self, n_blocks: int) -> list[int]:
        """The numbers, from 0, of its blocks among `n_blocks`."""
        groups = range(-(-n_blocks // self.n))
        blocks = [group * self.n + self._place(group) for group in groups]
        return [block for block in blocks if block < n_blocks]

    def has(self, block: int) -> bool:
        """Whether a block is one of its blocks."""
        group, place = divmod(block, self.n)
        return place == self._place(group)

    def _place(self, group: int) -> int:
        turned = (group * _GOLDEN % 2**64) * self.n >> 64
        return (self.k - 1 + turned) % self.n

    def part(self, whole: Path) -> Path:
        """Where its part of the store `whole` is: tiny.3-of-40.zarr beside tiny.zarr."""
        return whole.with_name(whole.name.removesuffix(".zarr") + self._ending)

    def whole(self, part: Path) -> Path:
        """The store of which `part` is its part; without the ending of `part`, a name like it."""
        name = part.name.removesuffix(self._ending).removesuffix(".zarr")
        return part.with_name(f"{name}.zarr")

    @property
    def _ending(self) -> str:
        return f".{self.k}-of-{self.n}.zarr"
