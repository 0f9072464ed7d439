"""Package of the library, its command line and its ROS 2 nodes (ament_python)."""

import platform
import sys
from pathlib import Path

from setuptools import Extension, find_packages, setup

NAME = "calib_planner"
PAPER = "calib_planner_paper"
SHARE = f"share/{NAME}"


def shared_tree(*folders):
    """Pairs (target folder, files) that keep each folder's tree below share/calib_planner."""
    files = [f for folder in folders for f in sorted(Path(folder).rglob("*")) if f.is_file()]
    files = [f for f in files if "__pycache__" not in f.parts]
    parents = sorted({f.parent for f in files})
    return [(f"{SHARE}/{p.as_posix()}", [str(f) for f in files if f.parent == p]) for p in parents]


FLAGS = ["-O3", "-fno-math-errno", "-ffp-contract=off"]
if sys.platform == "linux" and platform.machine() == "x86_64":
    FLAGS += ["-mprefer-vector-width=512"]  # a fifth faster on processors that have them

setup(
    name=NAME,
    version="0.1.0",
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
    author="The calib_planner authors",
    author_email="calib-planner@example.com",
    maintainer="The calib_planner authors",
    maintainer_email="calib-planner@example.com",
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
    install_requires=["numpy>=1.23", "scipy>=1.8", "PyYAML", "matplotlib>=3.5", "rich>=12", "Jinja2>=3"],
    extras_require={
        "test": ["pytest", "pytest-timeout", "hypothesis", "pin"],
        "docs": ["sphinx>=8.1", "myst-parser>=4", "furo"],
        "bags": ["rosbags"],
        "files": ["openpyxl"],
        "completion": ["shtab>=1.6"],
        "xacro": ["xacro>=2.1"],
        "threads": ["threadpoolctl>=3.1"],
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
        ],
    },
)
