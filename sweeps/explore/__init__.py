"""The explorer: a map in the browser that follows sliders, of the program itself or of a store.

- `view`: what is shown, as one record; it is the query of the page's address, and what undo keeps
- `cells`: a map in memory: a metric between two axes, and why some cells have no number
- `live`: maps that are computed: a view becomes a sweep, which runs anew with each movement
- `stored`: maps that are read: of a store, its rest cut or reduced
- `source`: what `live` and `stored` both have
- `motion`: the motion of one cell, by the program that computed the cell
- `worker`: a thread that computes; the newest request of a page wins
- `picture`: a map as a Bokeh figure; `signals`: motions as columns; they know of no server
- `texts`: a view as a sweep file, as Python, as a labelled dataset
- `page`: an open page: events in; maps, motions and words out. Its part in the browser is
  `page.html`, `page.css`, `page.js` and, for a shared file too, `page.drawing.js`
- `server`: listens on this machine, and refuses what other sites send

    event of a control -> View -> worker -> Map -> picture -> browser
"""
