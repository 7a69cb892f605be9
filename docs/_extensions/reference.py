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
    metrics,
    profile,
    rk4,
    simulation,
)
from figures.style import SYMBOLS, units_text
from sweeps.store.format import bound

# What a page says of the code in which a field stands, and that code.
USES = {
    "[eq. 1, 2](model.md#force-profile)": inspect.getsource(profile),
    "[Algorithm 1](model.md#algorithm-1)": inspect.getsource(controller),
    "[Algorithm 2](model.md#algorithm-2)": inspect.getsource(exploration),
    # without the rates, among which are those of the metrics
    "[plant](model.md#plant)": inspect.getsource(rk4.advance).partition("def rates")[0],
    "[contact](model.md#contact)": inspect.getsource(environment),
    "[start](model.md#time-and-start)": inspect.getsource(simulation.initial),
    "[metrics](model.md#metrics)": inspect.getsource(metrics.reachable),
}


def fields() -> Iterator[str]:
    """A row for each field of Params."""
    yield "| field | symbol | meaning | unit | default | bound | used in |"
    yield "|---|---|---|---|---:|---|---|"
    for name, about in QUANTITIES.items():
        used = [place for place, code in USES.items() if re.search(rf"\bp\.{name}\b", code)]
        symbol = SYMBOLS[name] if SYMBOLS[name].startswith("$") else ""
        default = f"{getattr(Params(), name):g}"
        yield _row(
            f"`{name}`",
            symbol.replace("Max", r"\mathrm{Max}").replace("{env}", r"\mathrm{env}"),
            _plain(about["meaning"]),
            units_text(about["unit"]),
            default,
            about["bound"],
            ", ".join(used),
        )


def choices() -> Iterator[str]:
    """A row for each choice of Model, with the words of its docstring."""
    words = inspect.getdoc(Model) or ""
    yield "| choice | options, the default first | meaning |"
    yield "|---|---|---|"
    for name, options in CHOICES.items():
        found = re.search(rf"^{name}: (.*(?:\n +.*)*)", words, re.MULTILINE)
        assert found, name
        listed = ", ".join(f"`{option}`" for option in options)
        yield _row(f"`{name}`", listed, _plain(" ".join(found[1].split())))


def metrics_rows() -> Iterator[str]:
    """A row for each metric, with the largest error of one that is trusted."""
    yield "| metric | meaning | unit | trusted if its error is at most |"
    yield "|---|---|---|---|"
    for name, about in METRICS.items():
        trust = "" if name == "finite" else bound(name)
        yield _row(f"`{name}`", _plain(about["meaning"]), units_text(about["unit"]), _plain(trust))


def signals() -> Iterator[str]:
    """A row for each signal of a Sample."""
    yield "| signal | meaning | unit |"
    yield "|---|---|---|"
    for name, about in SIGNALS.items():
        yield _row(f"`{name}`", _plain(about["meaning"]), units_text(about["unit"]))


def _plain(text: str) -> str:
    """A text of the program as Markdown: its * and _ are no emphasis, its | no column."""
    parts = text.split("`")  # every second part is code
    parts[::2] = [re.sub(r"([|*_])", r"\\\1", part) for part in parts[::2]]
    return "`".join(part.replace("|", r"\|") if i % 2 else part for i, part in enumerate(parts))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _directive(rows: Any) -> type[SphinxDirective]:
    class Table(SphinxDirective):
        def run(self) -> list[nodes.Node]:
            return self.parse_text_to_nodes("\n".join(rows()))

    return Table


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    tables = {"fields": fields, "choices": choices, "metrics": metrics_rows, "signals": signals}
    for name, rows in tables.items():
        app.add_directive(name, _directive(rows))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
