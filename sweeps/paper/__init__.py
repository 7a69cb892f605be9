"""`fic-sweep report`: the paper's claims, measured, judged and written down.

| file | what it holds |
|---|---|
| scenarios.py | the paper's scenarios: rows of a table, with their metrics or time histories |
| claims/ | a file of words and queries for each claim, C1.md to C15.md; their tables |
| judge.py | from a claim's table to its verdict |
| findings/ | studies beyond the claims: their data, tables and words |
| words.py | reads the files of words and computes the numbers in them |
| pages.py, page.md, page.css | the report as Markdown and HTML |
| report.py | the whole: stores, verdicts, findings, pictures, pages |
| loop.py, formulas.py | the loop, linearised; closed forms for it |
| simulink.py | runs in which the search is at the solver's stages or once a step of it |
| logs.py | what such a run logs, and metrics of it |
| accepted.py | the same once a step of scipy's solvers, one run at a time |
| superposition.py | several controllers on one inertia |

scenarios → claims → judge → pages → report, and beside the claims findings → pages.
"""
