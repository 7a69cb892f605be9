"""A store as one HTML file, which needs no program, no server and no network.

- `coarse`: a copy of a store that fits into a file: fewer digits, then fewer values of long axes
- `pins`: the cells whose motions the file has
- `page`: the file; `page.html`, `page.css` and `page.js` are its parts, beside the explorer's style

    store -> Copy, Pins -> page -> FILE.html
"""
