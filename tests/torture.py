"""`make torture` sets FIC_SWEEP_TORTURE: tests then try every case instead of some."""

import os

TORTURE = bool(os.environ.get("FIC_SWEEP_TORTURE"))


def many(some, every):
    """How many cases to try, or which."""
    return every if TORTURE else some
