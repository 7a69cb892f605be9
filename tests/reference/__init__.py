"""Independent reference simulators: plain Python and scipy, no JAX, no code of `fic_jax`.

laws.py         the laws: eq. 1 and 2, Algorithms 1 and 2, the contacts
discrete.py     the discretisation of `rk4`, step by step, and the metrics
events.py       its limit dt -> 0 by scipy, with located events (cells.py, record.py)
motion.py       the exact metrics of that limit, by Taylor polynomials between events (taylor.py)
scenarios.py    seeded random scenarios over all choices of the model
sensitivity.py  how much a small change of a scenario changes its motion and each metric
"""
