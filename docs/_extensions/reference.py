"""Tables of fields, choices, metrics and signals, made from the records of fic_jax.

A page writes `{fields}`, `{choices}`, `{metrics}` or `{signals}` as a directive. The texts, units,
bounds and defaults are those of the program; where a field is used is read from its source.
"""

import inspect
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from fic_jax import (
    CHOICES,
    METRICS,
    QUANTITIES,
    SIGNALS,
    Model,
    Params,
    controller,
    environment,
    exploration,
    profile,
    rk4,
    simulation,
)
from figures.style import SYMBOLS
from sweeps.store.format import bound

# What a page says of the code in which a field stands, and that code.
USES: dict[str, Any] = {
    "[eq. 1, 2](model.md#force-profile)": profile,
    "[Algorithm 1](model.md#algorithm-1)": controller,
    "[Algorithm 2](model.md#algorithm-2)": exploration,
    "[plant](model.md#plant)": rk4,
    "[contact](model.md#contact)": environment,
    "[start](model.md#time-and-start)": simulation.initial,
}


def fields() -> Iterator[str]:
    """A row for each field of Params."""
    yield "| field | symbol | meaning | unit | default | bound | used in |"
    yield "|---|---|---|---|---:|---|---|"
    for name, about in QUANTITIES.items():
        used = [
            place for place, code in USES.items() if re.search(rf"\bp\.{name}\b", _source(code))
        ]
        symbol = SYMBOLS[name] if SYMBOLS[name].startswith("$") else ""
        default = f"{getattr(Params(), name):g}"
        yield _row(
            f"`{name}`",
            symbol.replace("Max", r"\mathrm{Max}").replace("{env}", r"\mathrm{env}"),
            about["meaning"],
            about["unit"],
            default,
            about["bound"],
            ", ".join(used),
        )


def _source(code: Any) -> str:
    return inspect.getsource(code)


def choices() -> Iterator[str]:
    """A row for each choice of Model, with the words of its docstring."""
    words = inspect.getdoc(Model) or ""
    yield "| choice | options, the default first | meaning |"
    yield "|---|---|---|"
    for name, options in CHOICES.items():
        found = re.search(rf"^{name}: (.*(?:\n +.*)*)", words, re.MULTILINE)
        assert found, name
        listed = ", ".join(f"`{option}`" for option in options)
        yield _row(f"`{name}`", listed, " ".join(found[1].split()).replace("|", r"\|"))


def metrics() -> Iterator[str]:
    """A row for each metric, with the largest error of one that is trusted."""
    yield "| metric | meaning | unit | trusted if its error is at most |"
    yield "|---|---|---|---|"
    for name, about in METRICS.items():
        trust = "" if name == "finite" else bound(name)
        meaning = about["meaning"].replace("|", r"\|")
        yield _row(f"`{name}`", meaning, about["unit"], trust)


def signals() -> Iterator[str]:
    """A row for each signal of a Sample."""
    yield "| signal | meaning | unit |"
    yield "|---|---|---|"
    for name, about in SIGNALS.items():
        yield _row(f"`{name}`", about["meaning"], about["unit"])


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _directive(rows: Any) -> type[SphinxDirective]:
    class Table(SphinxDirective):
        def run(self) -> list[nodes.Node]:
            for module in (profile, controller, exploration, environment, rk4, simulation):
                self.env.note_dependency(module.__file__)
            return self.parse_text_to_nodes("\n".join(rows()))

    return Table


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    for rows in (fields, choices, metrics, signals):
        app.add_directive(rows.__name__, _directive(rows))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
