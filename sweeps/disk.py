"""What is the disk's fault: a failure, whatever the request was, and no mistake of the user."""

import errno

FULL_OR_BROKEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def refused(error: BaseException) -> bool:
    """Whether the disk is full, or broken."""
    return isinstance(error, OSError) and error.errno in FULL_OR_BROKEN
