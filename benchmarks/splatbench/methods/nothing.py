"""The asset as it is: the lower line of every table, and what "unchanged" costs in the edited region."""

from __future__ import annotations

from splatbench.methods import Budget, Done, Method, Work


def edit(work: Work, budget: Budget) -> Done:
    """The asset, unedited."""
    return Done(work.asset, 0.0, 0.0, note="the asset before the edit; nothing is done")


METHODS = (
    Method(
        name="nothing",
        label="Asset as it is",
        edit=edit,
        protocols=("refine", "relight", "creative", "compress", "sequence", "ablate"),
    ),
)
