"""The summary page of a batch: every asset before and after, in one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import os
from collections import Counter
from importlib.resources import files as resources
from pathlib import Path
from typing import Any

from splatpainter.batch.plan import Job, JobList
from splatpainter.commands.batch.work import AFTER, BEFORE
from splatpainter.io import files
from splatpainter.system.atomic import write_text

STATES = ("done", "failed", "cancelled")
MAX_PREVIEW_BYTES = 1 << 20
"""Most bytes of a picture on the page."""


def require_jinja() -> None:
    """Raises ValueError saying what to install."""
    try:
        import jinja2
    except ImportError:
        raise ValueError("splatpainter batch: needs Jinja2; pip install 'splatpainter[batch]'") from None
    assert jinja2


def write_page(plan: JobList, records: list[dict[str, Any]]) -> None:
    """OUT/index.html."""
    import jinja2

    # Names of files come from the user, so the template escapes all that it shows; a missing value is an error.
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        resources("splatpainter.commands.batch").joinpath("page.html.j2").read_text("utf-8")
    )
    jobs = [_entry(plan, job, record) for job, record in zip(plan.jobs, records, strict=True)]
    states = Counter(record["status"] for record in records)
    # A count of nothing is shown too, so the page looks alike for all batches.
    text = template.render(title=plan.file.stem, jobs=jobs, **{name: states[name] for name in STATES})
    write_text(plan.out / "index.html", text)


def _entry(plan: JobList, job: Job, record: dict[str, Any]) -> dict[str, Any]:
    # What a failed job made is no result, so nothing of it is linked.
    done = record["status"] == "done"
    return {
        "name": job.name,
        "asset": str(job.asset),
        "edits": ", ".join(step.kind for step in job.steps),
        "error": record.get("error", ""),
        "warnings": record.get("warnings", []),
        "touched": f"{record['touched']:,}" if done else "",
        "rows": f"{record['rows']:,}" if done else "",
        "appended": f"{record['appended']:,}" if done else "",
        "psnr": ", ".join(f"{value:.1f} dB" for value in record.get("psnr", []) if value is not None),
        "note": record.get("note", ""),
        "out": _link(plan, job.out) if done else "",
        "receipt": _link(plan, Path(record["receipt"])) if done else "",
        "before": _picture(job.folder / BEFORE) if done else "",
        "after": _picture(job.folder / AFTER) if done else "",
    }


def _link(plan: JobList, path: Path) -> str:
    # Relative, so that the folder of results can be moved or sent as it is.
    return Path(os.path.relpath(path, plan.out)).as_posix()


def _picture(path: Path) -> str:
    """A data: URL; "" where there is none."""
    try:
        # Inside the page: it has to show everything without another file.
        return "data:image/webp;base64," + base64.b64encode(files.read_head(path, MAX_PREVIEW_BYTES)).decode()
    except ValueError:
        return ""
