# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Package of the library, its command line and its ROS 2 nodes (ament_python).

*The interfaces* are a package of their own in ``msg_defs``, since an ament_python package cannot generate any.
colcon does not look for packages below another one, so that ``colcon build`` finds this package alone. When it
is installed the interfaces are built, too, by colcon itself and into the same workspace. Where colcon was told
of both (``--base-paths``, or a link beside the checkout), or where they are installed already, nothing is built.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.develop import develop
from setuptools.command.install import install

NAME = "calib_planner"
INTERFACES = "calib_planner_msgs"
PAPER = "calib_planner_paper"
SHARE = f"share/{NAME}"


def shared_tree(*folders):
    """Pairs (target folder, files) that keep each folder's tree below share/calib_planner."""
    files = [f for folder in folders for f in sorted(Path(folder).rglob("*")) if f.is_file()]
    files = [f for f in files if "__pycache__" not in f.parts]
    parents = sorted({f.parent for f in files})
    return [(f"{SHARE}/{p.as_posix()}", [str(f) for f in files if f.parent == p]) for p in parents]


def build_interfaces(build_base):
    """Have colcon build the interfaces, if it is colcon that installs this package and they are not there.

    Raises:
        SystemExit: They could not be built; the text holds the line to type.
    """
    prefix, source = Path(sys.prefix), Path(__file__).resolve().parent
    merged = (prefix / ".colcon_install_layout").is_file()
    workspace = prefix if merged else prefix.parent
    if not (workspace / ".colcon_install_layout").is_file():
        return  # pip, or a distribution's build: its packages are separate
    ours = prefix if merged else workspace / INTERFACES
    folder = Path(build_base).resolve().parent / INTERFACES
    manifest = f"share/{INTERFACES}/package.xml"
    known = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    if any((p / manifest).is_file() and not (p == ours and folder.is_dir()) for p in known):
        return
    print(f"building {INTERFACES}, which colcon does not look for below {source.name}", flush=True)
    environment = dict(os.environ)
    # What colcon put in front for this package alone would change where Python and CMake install.
    private = ("prefix_override", "colcon_distutils_commands")
    paths = environment.pop("PYTHONPATH", "").split(os.pathsep)
    environment["PYTHONPATH"] = os.pathsep.join(p for p in paths if p and Path(p).name not in private)
    command = ["colcon", "--log-base", str(folder / "log"), "build", *(["--merge-install"] if merged else [])]
    command += ["--base-paths", str(source / "msg_defs"), "--event-handlers", "console_cohesion+"]
    command += ["--build-base", str(folder), "--install-base", str(workspace)]
    try:
        status = subprocess.run(command, env=environment, cwd=source).returncode
    except FileNotFoundError:
        status = 127
    if status:
        sys.exit(
            f"{INTERFACES} was not built (status {status}); see above, and name both packages:\n"
            f"    colcon build --base-paths {source} {source / 'msg_defs'}"
        )


class Install(install):
    """``colcon build``."""

    def run(self):
        """Install, then the interfaces."""
        super().run()
        build_interfaces(self.get_finalized_command("build").build_base)


class Develop(develop):
    """``colcon build --symlink-install``."""

    def run(self):
        """Link, then the interfaces."""
        super().run()
        build_interfaces(Path("build"))


FLAGS = ["-O3", "-fno-math-errno", "-ffp-contract=off"]
if sys.platform == "linux" and platform.machine() == "x86_64":
    FLAGS += ["-mprefer-vector-width=512"]  # a fifth faster on processors that have them

setup(
    name=NAME,
    version="1.0.0",
    description="Plans robot calibration measurements and identifies geometrical parameters",
    long_description=(Path(__file__).resolve().parent / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    keywords=["robot calibration", "laser tracker", "optimal experimental design", "ROS 2", "URDF"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Environment :: Console",
        "Intended Audience :: Manufacturing",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: C",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.10",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    author="calib_planner contributors",
    author_email="calib-planner@example.com",
    maintainer="calib_planner contributors",
    maintainer_email="calib-planner@example.com",
    url="https://example.com/calib_planner",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=[*find_packages(include=[NAME, f"{NAME}.*"]), PAPER],
    package_dir={PAPER: f"paper/{PAPER}"},
    # Optional: without a compiler NumPy does the same, several times slower.
    ext_modules=[
        Extension(
            f"{NAME}.{room}._kernel",
            [f"{NAME}/{room}/kernel.c"],
            extra_compile_args=FLAGS,
            optional=True,
        )
        for room in ("robot", "planning")
    ],
    package_data={NAME: ["py.typed", "report/templates/*.*"], PAPER: ["reproduction.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *shared_tree("config", "launch"),
    ],
    zip_safe=False,
    cmdclass={"install": Install, "develop": Develop},
    install_requires=["numpy>=1.23", "scipy>=1.8", "PyYAML", "matplotlib>=3.5", "rich>=12", "Jinja2>=3"],
    extras_require={
        "test": ["pytest", "pytest-timeout", "hypothesis", "pin"],
        "docs": ["sphinx>=8.1", "myst-parser>=4", "furo"],
        "bags": ["rosbags"],
        "page": ["aiohttp>=3.9"],
        "files": ["openpyxl"],
        "completion": ["shtab>=1.6"],
        "xacro": ["xacro>=2.1"],
        "threads": ["threadpoolctl>=3.1"],
        "fuzz": ["atheris"],
        "collision": ["pin"],
        "distributed": ["dask[distributed]"],
    },
    entry_points={
        "console_scripts": [
            "calib-planner = calib_planner.cli:main",
            "planner_node = calib_planner.ros.nodes.planner:main",
            "identifier_node = calib_planner.ros.nodes.identifier:main",
            "simulator_node = calib_planner.ros.nodes.simulator:main",
            "campaign_node = calib_planner.ros.nodes.campaign:main",
            "executor_node = calib_planner.ros.nodes.executor:main",
            "page_node = calib_planner.ros.nodes.page:main",
        ],
    },
)
