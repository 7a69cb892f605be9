"""The recipes of docs/clusters.md run as printed: stand-ins for the schedulers run jobs here."""

import json
import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import xarray as xr

from tests.cli.conftest import TINY
from tests.command import FIC_SWEEP, typed

PAGE = (Path(__file__).parent.parent.parent / "docs" / "clusters.md").read_text(encoding="utf-8")
N = 2  # shards, instead of the page's 40: a process takes a second

# As Slurm does it: the options are in the script or the command line; --wrap is a script.
SBATCH = """#!/bin/bash
for word; do
  case $word in
    --array=*) array=${word#*=} ;;
    --wrap) wrap=1 ;;
    -*) ;;
    *) script=$word ;;
  esac
done
if [ "$wrap" ]; then exec bash -c "$script"; fi
: ${array:=$(sed -n 's/^#SBATCH --array=//p' "$script")}
export SLURM_CPUS_PER_TASK=16
for range in ${array//,/ }; do
  for i in $(seq ${range%-*} ${range#*-}); do
    SLURM_ARRAY_TASK_ID=$i bash "$script" >&2 || exit 1
  done
done
echo 1234
"""
SRUN = '#!/bin/sh\nshift\nexec "$@"\n'
SSH = """#!/bin/sh
if [ "$1" = gone ]; then exit 255; fi
echo "$1" >> reached
exec sh -c "$2"
"""


def block(language, word):
    """The one block of code that contains a word, for fewer shards."""
    blocks = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    (found,) = (text for text in blocks if word in text)
    return re.sub(r"(?<=[-/ ])40\b", str(N), found)


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """The working directory, with mine.toml of four blocks and stand-ins in the PATH."""
    monkeypatch.chdir(tmp_path)
    four = TINY.replace('"tiny"', '"mine"').replace("Td = [1.0, 5.0, 12.0]", "")
    Path("mine.toml").write_text(four)
    for name, text in {"sbatch": SBATCH, "srun": SRUN, "ssh": SSH}.items():
        place = tmp_path / "bin" / name
        place.parent.mkdir(exist_ok=True)
        place.write_text(text)
        place.chmod(0o755)
    return tmp_path


def shell(text, code=0, **variables):
    """Run a script; `fic-sweep run` makes blocks of one cell."""
    places = (os.path.abspath("bin"), os.path.dirname(FIC_SWEEP), os.environ["PATH"])
    text = text.replace("run mine.toml", "run mine.toml --chunk 1")
    done = subprocess.run(
        ["bash", "-ec", text],
        env=os.environ | {"PATH": ":".join(places), "PYTHONUTF8": "1"} | variables,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == code, done.stderr + done.stdout
    return done


def whole(path):
    with xr.open_zarr(path) as data:
        assert (data["status"] == 1).all()
        assert data["status"].size == 4
        assert len(json.loads(data.attrs["parts"])) == N


def test_slurm(cluster):
    script = block("bash", "#SBATCH").replace("run mine.toml", "run mine.toml --chunk 1")
    Path("shards.sh").write_text(script)
    shell(block("bash", "--parsable"))
    whole("results/mine.zarr")
    again = shell("sbatch --array=2 shards.sh")  # as the page says; a requeue does the same
    assert again.stderr == "results/mine.2-of-2.zarr: complete already, 2 scenarios\n"


def test_kubernetes(cluster):
    job = block("yaml", "kind: Job")
    (words,) = re.findall(r"^ +command: (\[.*\])$", job, re.MULTILINE)
    program, option, line = json.loads(words)
    assert (program, option) == ("sh", "-c")
    assert f"completions: {N}\n" in job
    for index in range(N):
        shell(line, JOB_COMPLETION_INDEX=str(index))
    (merge,) = re.findall(r"^`(fic-sweep merge .*)`\.$", PAGE, re.MULTILINE)
    shell(merge.replace("40", str(N)))
    whole("mine.zarr")


def test_a_list_of_hosts(cluster):
    Path("hosts.txt").write_text("".join(f"host{k}\n" for k in range(1, N + 1)))
    shell(block("bash", "cat -n hosts.txt"))
    assert sorted(Path("reached").read_text().split()) == ["host1", "host2"]
    whole("results/mine.zarr")


def test_a_host_that_has_gone(cluster):
    """Ssh exits with 255, which ends xargs: the other hosts run all the same, and merge waits."""
    Path("hosts.txt").write_text("gone\nhost2\n")
    ended = shell("set +e\n" + block("bash", "cat -n hosts.txt"), code=2)
    assert ended.stdout.startswith("results/mine.2-of-2.zarr: 2 scenarios in ")
    assert "results/mine.zarr: of 2 shards, 1 is missing (" in ended.stderr


def test_the_commands_of_two_machines(cluster):
    (text,) = re.findall(r"```sh\n(fic-sweep run \S+ --shard .*?)```", PAGE, re.DOTALL)
    text = text.replace("--x Td --y K0", "--x K0")  # mine.toml has one axis
    text = text.replace("run mine.toml", "run mine.toml --chunk 1")
    said = ""
    for line in text.splitlines():
        ended = typed(*shlex.split(line, comments=True)[1:])
        assert ended.code == 0, ended
        said += ended.stdout
    assert "shard     1/2, 2 scenarios in 2 blocks\ndone      2 of 2 cells" in said
    assert "mine.zarr: 4 scenarios of 2 parts\n" in said
