"""`fic-sweep` as a user types it, in a process of its own."""

import shutil
import subprocess
import sysconfig

FIC_SWEEP = shutil.which("fic-sweep", path=sysconfig.get_path("scripts"))


def call(*arguments, code, folder=None, environment=None):
    """What it printed, once it ended with `code` and without a traceback."""
    done = subprocess.run(
        [FIC_SWEEP, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == code, done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    return done
