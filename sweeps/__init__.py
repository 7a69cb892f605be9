"""Sweeps: from a sweep file to a store of results, and on to tables, pictures and the report.

- `spec`: reads and checks a sweep file; `library`: the sweeps that come with the program
- `plan`: its scenarios, block by block
- `store`: the result store on disk
- `merge`: one store of the shards of a sweep
- `reduce`: the statistics of a reduced store, from cells that are computed or read
- `runner`: computes the blocks of a store; `provenance`: names the program and the machine
- `devices`: starts JAX, or names the variable of the environment that keeps it from starting
- `compile_cache`, `processor`: where compiled programs are kept, one folder for each processor
- `disk`: which errors are the disk's and no mistake of the user
- `export`: a store as CSV, Parquet or NetCDF
- `paper`: the paper's scenarios and claims, and the report about them
- `cli`: the command `fic-sweep`

Imports point one way: cli -> paper -> runner -> reduce -> store -> plan -> spec -> fic_jax.
"""

from pathlib import Path

LIBRARY = Path(__file__).parent / "library"
