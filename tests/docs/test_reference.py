"""The reference leaves nothing out: fields, choices, metrics, keys of sweep files, names."""

import importlib.util
import re

from pydantic import BaseModel

import fic_jax
from fic_jax import CHOICES, METRICS, QUANTITIES, SIGNALS
from sweeps.spec.types import Sweep
from tests.docs.blocks import ROOT


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text("utf-8")


def test_every_key_of_a_sweep_file_is_explained():
    """A table of its own, as `[reduce]`, may be explained on a page of that name."""
    missing = []
    for key, field in Sweep.model_fields.items():
        tables = [kind for kind in (field.annotation, *_parts(field.annotation)) if _record(kind)]
        text = page("sweep_file.md")
        if tables and f"[{key}]" in text and (ROOT / "docs" / f"{key}.md").is_file():
            text += page(f"{key}.md")
        names = [key, *(name for table in tables for name in table.model_fields)]
        missing += [f"{key}: {name}" for name in names if not re.search(rf"\b{name}\b", text)]
    assert not missing


def _parts(annotation: object) -> tuple[object, ...]:
    return getattr(annotation, "__args__", ())


def _record(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def test_every_public_name_is_in_the_api():
    names = set(fic_jax.__all__) - {"__version__"}
    assert {name for name in names if not re.search(rf"\b{name}\b", page("api.md"))} == set()


def test_the_tables_have_a_row_for_each_name():
    path = ROOT / "docs" / "_extensions" / "reference.py"
    spec = importlib.util.spec_from_file_location("docs_reference", path)  # tests/reference differs
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    tables = {
        reference.fields: QUANTITIES,
        reference.choices: CHOICES,
        reference.metrics_rows: METRICS,
        reference.signals: SIGNALS,
    }
    for rows, names in tables.items():
        text = list(rows())[2:]
        assert [re.match(r"\| `(\w+)`", row)[1] for row in text] == list(names)
    unused = [row for row in reference.fields() if row.endswith("|  |")]
    assert not unused  # each field stands in an equation
