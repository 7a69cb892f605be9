"""Everything that is measured on an NVIDIA card, by one command: `python -m benchmarks.gpu`.

__main__.py    the command: options, the parts in order, a time limit for each
session.py     sizes; the time that is left; calls to child processes that end in time
results.py     results.jsonl, to which each result is appended; the tables made from it
card.py        part `machine`: the card, driver, versions; memory used on the card
agreement.py   parts `bits` and `correctness`: a backend's metrics against the CPU's, bit for bit
speed.py       part `rates`: whole calls and kernels, beside a CUDA twin and a scan
reduced.py     part `reduced`: scenarios made and metrics reduced on the card
memory.py      part `memory`: the most memory that a sweep needs on the card

A part is a module with `measure(session)`, which adds records, and `tables(records)`, which makes
Tables of them; `PARTS` in __main__.py has its name. It needs jax, numpy and fic_jax, no network and
no installation. The parent starts no JAX: whatever a kernel breaks, it breaks a child only.
"""
