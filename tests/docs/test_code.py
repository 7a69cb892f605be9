"""Every code block of the documentation runs, or is checked as far as this machine can."""

import re
from pathlib import Path

import jax
import matplotlib
import pytest
from markdown_it import MarkdownIt
from matplotlib import pyplot as plt

from tests.docs.blocks import NOT_RUN, ROOT, RUN, SYBIL, nothing_unsaid

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += sorted((ROOT / "benchmarks").rglob("*.md"))


@pytest.fixture
def as_users_have_it(tmp_path, monkeypatch):
    """An empty folder, single precision, no strict promotion; pictures on no screen."""
    monkeypatch.chdir(tmp_path)
    jax.config.update("jax_enable_x64", False)  # a page may turn it on, as a user would
    matplotlib.use("agg")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield
    plt.close("all")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_code_of_a_page_runs(page: Path, as_users_have_it):
    document = SYBIL.parse(page)
    for example in document.examples():
        example.evaluate()
    if document.regions:
        nothing_unsaid(example)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_names_a_language_that_is_tried(page: Path):
    blocks = [
        token.info for token in MarkdownIt().parse(page.read_text("utf-8")) if token.type == "fence"
    ]
    directives = re.compile(r"\{[\w-]+\}.*")
    assert {info for info in blocks if not directives.fullmatch(info)} <= RUN.keys() | NOT_RUN
