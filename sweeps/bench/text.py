"""The tables as text for a terminal and as Markdown for a README. Prints nothing."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sweeps.bench.plan import Table


@dataclass(frozen=True)
class Section:
    """One table in words: its cells are text, the first column is left-aligned."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    notes: list[str]


def as_text(result: Table) -> str:
    """For a terminal."""
    lines = _where(result)
    for section in _sections(result):
        widths = [max(map(len, column)) for column in zip(section.head, *section.rows, strict=True)]
        lines += ["", section.title]
        for row in (section.head, *section.rows):
            cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
            lines.append("  ".join([f"{row[0]:{widths[0]}}", *cells[1:]]).rstrip())
        lines += section.notes
    return "\n".join(lines)


def as_markdown(result: Table) -> str:
    """For a README."""
    lines = [f"- {line}" for line in _where(result)]
    for section in _sections(result):
        lines += ["", f"**{section.title}**", ""]
        rule = ("---", *["---:"] * (len(section.head) - 1))
        lines += [f"| {' | '.join(row)} |" for row in (section.head, rule, *section.rows)]
        lines += [f"\n{note}" for note in section.notes]
    return "\n".join(lines)


def _where(result: Table) -> list[str]:
    at, versions = result["machine"], result["versions"]
    vector = ", ".join(at["vector"]) or "no known vector extension"
    load = " ".join(f"{load:.2f}" for load in at["load"])
    told = [f"{name} {version}" for name, version in versions.items() if version]
    return [
        f"{at['cpu']} ({at['architecture']}), {at['cores']} cores in use, {vector}",
        ", ".join(told),
        f"load average at the start {load}",
    ]


def _sections(result: Table) -> Iterator[Section]:
    makers: dict[str, Callable[[Table], Section]] = {
        "rates": _rates,
        "scaling": _scaling,
        "run": _run,
        "first": _first,
    }
    for name, table in result["tables"].items():
        yield makers[name](table)


def _rates(table: Table) -> Section:
    rows = []
    for row in table["rows"]:
        rate, ratio = row["steps_per_s"], row.get("engine_over_it")
        cells = [f"{rate['median'] / 1e6:.1f}", f"{rate['best'] / 1e6:.1f}"]
        cells += [f"{ratio['median']:.2f}", f"{ratio['best']:.2f}"] if ratio else ["", ""]
        rows.append((row["name"], f"{row['scenarios']:,}", *cells, *_target(row)))
    return Section(
        f"Rates: default model, float32 unless said otherwise, {table['steps']:,} steps, "
        "all metrics",
        (
            "", "scenarios", "M steps/s, median", "best",
            "engine / it, median of rounds", "of the bests", "target", "met",
        ),
        rows,
        [f"{name}: not measured: {why}" for name, why in table["missing"].items()],
    )  # fmt: skip


def _scaling(table: Table) -> Section:
    rows = []
    for row in table["rows"]:
        times = [row[key][what] for key in ("all_us", "one_us") for what in ("median", "best")]
        cells = [f"{value:.2f}" for value in (*times, row["one_over_all"]["median"])]
        rows.append((f"{row['scenarios']:,}", *cells))
    return Section(
        f"Cost of a scenario of {table['steps']:,} steps, in microseconds",
        ("scenarios", "all devices, median", "best", "one device, median", "best", "one / all"),
        rows,
        [],
    )


def _run(table: Table) -> Section:
    peak, more = table["peak_bytes"], table["peak_of_more"]
    seconds = {
        "bare engine, s": "engine_s",
        "fic-sweep run, whole process, s": "run_s",
        "  of it starting: interpreter, imports": "start_s",
        "  of it compiling": "compile_s",
        "engine / (whole less compiling)": "engine_over_run",
        "engine / (whole less compiling and starting)": "engine_over_run_less_start",
    }
    rows = []
    for name, key in seconds.items():
        value = table[key]
        rows.append((name, f"{value['median']:.3f}", f"{value['best']:.3f}", *_target(value)))
    rows.append(("peak memory, MB", f"{peak['value'] / 1e6:.0f}", "", *_target(peak, 1e6)))
    name = f"  with {more['scenarios']:,} scenarios of {more['steps']:,} steps"
    rows.append((name, f"{more['value'] / 1e6:.0f}", "", "", ""))
    rows.append(("  ratio of the two", f"{more['ratio']:.3f}", "", *_target(more)))
    title = f"A run of {table['scenarios']:,} scenarios of {table['steps']:,} steps into a store"
    return Section(title, ("", "median", "best", "target", "met"), rows, [])


def _first(table: Table) -> Section:
    rows = []
    for row in table["rows"]:
        seconds = row["seconds"]
        cells = (f"{seconds['median']:.2f}", f"{seconds['best']:.2f}")
        rows.append((row["name"], *cells, *_target(row)))
    return Section(
        f"First result: whole processes of fic-sweep, {table['steps']:,} steps, in seconds",
        ("", "median", "best", "target", "met"),
        rows,
        [],
    )


def _target(row: dict[str, Any], unit: float = 1.0) -> tuple[str, str]:
    if "target" not in row:
        return "", ""
    ((bound, value),) = row["target"].items()
    return f"{bound.replace('_', ' ')} {value / unit:.3g}", "yes" if row["met"] else "no"
