"""Results for people: records of a run become tables, plots, contact sheets and one HTML page.

    summary.py    records -> one row per method and block: means, bootstrap intervals, medians; curves; order of methods
    tables.py     rows as CSV, Markdown and LaTeX
    published.py  the figures that the paper prints
    plots.py      which figure against which, drawn by matplotlib
    gallery.py    which cases are shown in pictures; contact sheets
    page.py       the HTML page (page.html.j2, page.css, page.js) and the Markdown file

Knows no methods and no tables but by their names, columns and files.
"""
