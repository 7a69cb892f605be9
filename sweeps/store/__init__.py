"""The result store: one Zarr directory that `xarray.open_zarr` reads without this package.

Read the files in this order; each uses only those above it.

    place.py     resolve the path of a store
    fsync.py     put whole files on the disk
    lock.py      let one process at a time change a store
    ledger.py    ledger.sqlite: one row for each finished block, with the checksums of its files
    reduced.py   the variables of a reduced store
    format.py    what is on the disk: arrays, flags, attributes
    journal.py   what a refined run has simulated, until its blocks are written
    opening.py   open a store, count it, read it
    create.py    make an empty store, or build another: whole, or not at all
    commit.py    write one block
    extend.py    copy a store into a larger one
    verify.py    compare every file with the ledger; repair the metadata

A block is a box of cells: one chunk file of each variable. It is the unit of work and of commit.
A block is done if, and only if, the ledger has its row. `Writer.commit` works in this order:

    1. encode each variable in memory
    2. write each file as NAME.partial and fsync it
    3. delete the block's old row, if it has one
    4. rename each file to NAME
    5. fsync the folders
    6. insert the row into the ledger; SQLite fsyncs it

A kill or a power cut before the end of step 6 leaves a block without a row, or with its old row and
its old files; `resume` runs it again. After step 6 the files and the row are on the disk: the block
is durable. On a cluster the worker that computed a block does steps 1 and 2, under a name of its
own, and the one process that has locked the store does the rest.
"""
