"""The paper's tables (arXiv 2512.05354, Section 4 and supplement), with every system in them.

    cases.py       what a table asks: an asset, edited pictures, and the truth that methods never see
    protocols/     one file per table: which cases, how they are scored, how the table is laid out
    methods/       one file per row, or per family of rows: asset and edited pictures in, edited asset out
    records.py     what came out, one small file per case and method: resuming is finding them
    runner.py      cases x methods, each method in a process of its own (worker.py, children.py)
    stock.py       cases on disk, made once; notes.py says what a reader must know beside the figures
    published.py   the paper's own figures
    report/        records as CSV, Markdown, LaTeX, contact sheets and one HTML page

Data flows down this list once; methods and protocols never import each other.
"""
