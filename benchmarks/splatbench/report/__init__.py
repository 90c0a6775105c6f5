"""What came out, for people: records (records.py) become tables, plots, contact sheets and one HTML page.

    summary.py   records -> one row per method and block: means, bootstrap intervals, medians
    names.py     what methods are called, in which order, and which mark is theirs
    curves.py    quality on the way of methods that take steps
    runs.py      what a run left in its folder: records and notes
    tables.py    rows as CSV, Markdown and LaTeX
    scales.py    axes as numbers: ticks, and from values to places
    labels.py    where text goes, so that it does not collide
    svg.py       axes, lines, points, text and legends as SVG
    plots.py     which figure against which
    pictures.py  the pictures of a run: which cases are shown, and where they lie
    sheets.py    contact sheets
    grid.py      a table as HTML; paper_grid.py: the paper's own, below it
    gallery.py   picture rows as HTML
    page.py      the page, with page_style.py and page_script.py in it

Knows no method and no protocol but by their names, columns and files.
"""
