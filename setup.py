"""Compiles native/ into the package: one wheel per platform for all Pythons (py3-none-PLATFORM).

SPLATPAINTER_TARGET (zig's name of a system, see native/build.py) builds the wheel of another one.
"""

import gzip
import os
import runpy
from pathlib import Path
from types import SimpleNamespace

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
native = SimpleNamespace(**runpy.run_path(str(ROOT / "native" / "build.py")))
TARGET = os.environ.get("SPLATPAINTER_TARGET", "")


def pack(folder):
    """Files of the studio's page as NAME.gz, a quarter of the size (splatpainter/server/packed_files.py)."""
    for path in sorted(folder.glob("*")):
        if path.suffix in (".js", ".css"):
            path.with_name(path.name + ".gz").write_bytes(gzip.compress(path.read_bytes(), mtime=0))
            path.unlink()


class BuildPy(build_py):
    def run(self):
        super().run()
        library = native.build(TARGET)
        # An editable install runs from the sources: the library goes beside them.
        package = ROOT / "src" if self.editable_mode else Path(self.build_lib)
        folder = package / "splatpainter" / "kernels"
        for name in native.LIBRARIES.values():  # nothing of another system, nor of an earlier build
            (folder / name).unlink(missing_ok=True)
        self.copy_file(str(library), str(folder / library.name))
        if not self.editable_mode:
            pack(package / "splatpainter" / "server" / "static")


class Wheel(bdist_wheel):
    def finalize_options(self):
        super().finalize_options()
        self.root_is_pure = False

    def get_tag(self):
        target = TARGET or native.target_here()
        return "py3", "none", native.PLATFORMS.get(target) or super().get_tag()[2]


class Binary(Distribution):
    def has_ext_modules(self):
        return True


setup(cmdclass={"build_py": BuildPy, "bdist_wheel": Wheel}, distclass=Binary)
