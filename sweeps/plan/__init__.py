"""The scenarios of a Sweep, block by block; no array of all of them ever exists.

`grid.Grid` knows the dimensions of a sweep and cuts its cells into blocks. `Grid.params(block)`
makes the Params of one block, `Grid.model(block)` its Model. `random_design.draw` makes the
scenarios of a `[sample]`: any part of the design, without the scenarios before it. `shard.Shard` is
a share of the blocks.
"""
