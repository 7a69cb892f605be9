"""From a sweep file to a checked Sweep.

1. `reading.load` reads the file, at most 1 MB; `reading.parse` turns its TOML into a plain record.
2. `overrides.override` changes the record: one `--set KEY=VALUE` after another.
3. `types.Sweep` checks the record key by key: type, finite number, length, no unknown key.
4. `rules` checks what needs more than one key: names, places, sizes, the time grid, bounds.
5. `mistakes` writes one line for each mistake; `reading` raises them together as a SweepError.
6. Otherwise the caller gets the Sweep: frozen, equal to any other Sweep of the same record.

A store keeps the record as JSON, and its hash. Opening a store checks the hash and repeats step 3
alone.
`condition` reads and evaluates a condition of `[reduce]` or `[refine]`.
`warnings` has a line for what is allowed but may surprise; `digits` says how many digits of a value
to print.
"""
