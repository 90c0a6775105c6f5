"""scripts/mutants.py: its mistakes can still be made."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mutants", ROOT / "scripts/mutants.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules["mutants"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_mutation_still_stands_in_its_file_and_names_tests_that_are_there() -> None:
    """Text that has moved away is never changed, and its tests are asked nothing."""
    mutants = script()
    for mutation in mutants.mutations():
        text = mutants.path_of(mutation, mutants.PACKAGES).read_text(encoding="utf-8")
        assert text.count(mutation.old) == 1 and mutation.new != mutation.old, mutation.name
        assert all((ROOT / test).exists() for test in mutation.tests), mutation.name
