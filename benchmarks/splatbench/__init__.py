"""Benches: speed of every stage, and quality of local edits on given assets, as CSV, Markdown and contact sheets.

A leaf: nothing but the command line imports it. Every bench is a frozen dataclass and `run(config) -> rows`.
"""
