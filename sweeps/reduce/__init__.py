"""From cells to a reduced store: `[reduce]` of a sweep file.

- `fold`: the statistics of a block of a reduced store, from the cells that it is made of
- `stored`: a reduced store from the cells of another store

A block of a reduced store has some cells of the dimensions that stay, each with all its
combinations of those that go. `fold.block_values` asks for these scenarios in boxes, whoever
computes or reads them, and folds box after box. Nothing is shared between blocks: a block is
committed, verified, lost and run again as any other.

The boxes along the dimensions that go depend on the sweep alone, and each cell is summed by itself,
so that the bits depend neither on the blocks nor on who ran them.
"""
