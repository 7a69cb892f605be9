"""Everything that measures speed. `fic-sweep bench` and `python -m benchmarks` print its tables.

measure.py          takes the tables that a Plan (plan.py: sizes, rounds) asks for
rates.py            plant steps per second of each implementation; cost against the scenarios
implementations.py  the engine with its options, and the peers: all compute the same metrics
peers/              a C++ and a CUDA twin, numba, diffrax, plain jit(vmap(scan))
whole_runs.py       `fic-sweep run` as whole processes: a long run, the first result
fic_sweep.py        one such process: its seconds, its start, its compile time, its memory
commit.py           what committing blocks to a store adds to a run
child.py            the protocol: call functions in a fresh process, one JSON line per call
tables.py           the formatter: text, Markdown and JSON from the same rows
machine.py          processor, versions, load
work_precision.py   `python -m benchmarks.work_precision`: error against cost of several solvers
trust.py, gradients.py   errors and trust, derivatives: `python -m benchmarks.trust`, `.gradients`
solvers.py          those solvers; scenarios.py: what they solve
gpu/                `python -m benchmarks.gpu`: a GPU's bits against the CPU's, rates, memory

Each table starts its children, one for each implementation, and calls them in turn, so that only
one computes at a time. Their seconds become the rows of a Table, and `tables.render` writes it.
Timed processes import this package, so this file imports nothing.
"""
