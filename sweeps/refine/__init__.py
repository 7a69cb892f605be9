"""From a coarse grid to the cells that matter: `[refine]` of a sweep file.

- `boxes`: which boxes of the grid are halved, and which cells that needs
- `table`: the values of all cells that were simulated, and the value of each that was not
- `rounds`: computes round after round, and writes blocks
- `budget`: gives a store that its budget ended a larger one

The store has the finest grid. A box is a part of it between 2^d neighbouring cells of some level,
its corners; level 0 is the grid of the sweep file. A box whose known cells differ is halved along
each refined axis: all corners of its 2^d parts are simulated. That is one round, of boxes of all
levels at once. Known are the corners of a box, and what finer neighbours have on its faces, so that
a border which leaves the fine boxes is followed.

The next round depends on the values of the last ones alone. So an interrupted run needs no record
of its rounds: what it has simulated is in the store's journal, and `resume` goes through the rounds
again and simulates the cells that are missing. At the end, each cell that was not simulated gets
the values of a corner of its box, all blocks are written, and the journal is deleted.
"""
