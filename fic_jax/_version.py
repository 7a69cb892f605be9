"""Which fic_jax this is."""

import time

__version__ = "0.1.0"
LOADED = time.time()  # s; sources that change later are not what this process runs
