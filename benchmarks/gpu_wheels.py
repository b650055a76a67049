"""
Gather what a machine with a GPU, torch and no package registry lacks: wheels of Stable-Baselines3, Gymnasium, MuJoCo
and DeepMind Control, the last without what its suite does not need (locomotion, composer, the dog's meshes).

    python benchmarks/gpu_wheels.py FOLDER [--python 3.12]

The versions are those of the lock file, where it has one. ``make gpu`` installs them there.

Among them is what SBX lacks on a machine that has JAX for CUDA, Flax and Optax (7 MiB, nearly all of it TensorFlow
Probability, of which SBX asks for the nightly builds). JAX itself cannot be carried: with CUDA it is larger than all
else together may be. Without it the benchmark leaves SBX's row out, with a word. All together stay under ``LARGEST``.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

NAMES = (
    "stable-baselines3", "gymnasium", "cloudpickle", "farama-notifications", "mujoco", "dm-env", "dm-tree", "glfw",
    "pyopengl",
)  # fmt: skip
#: Packages that SBX needs besides JAX, Flax and Optax, which the machine has or has not, and what they bring along.
OF_SBX = ("sbx-rl", "tfp-nightly", "decorator", "gast")
#: MiB of all wheels.
LARGEST = 64
PLATFORMS = [f"manylinux_2_{n}_x86_64" for n in (17, 24, 26, 27, 28, 31, 34)] + [
    "manylinux1_x86_64",
    "manylinux2014_x86_64",
]
#: Of DeepMind Control.
LEFT_OUT = re.compile(r"^dm_control/(locomotion|composer|entities|blender|third_party|.*dog_assets|viewer|.*_test\.py)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where they are put")
    parser.add_argument("--python", default="3.12", help="version of Python there")
    args = parser.parse_args()
    lock = (Path(__file__).parents[1] / "constraints" / f"{args.python}.txt").read_text()
    pins = dict(re.findall(r"^([A-Za-z0-9_.-]+)==(\S+)", lock, re.MULTILINE))
    args.folder.mkdir(parents=True, exist_ok=True)
    for old in args.folder.glob("*.whl"):
        old.unlink()
    download(args.folder, args.python, [pinned(name, pins) for name in NAMES])
    download(args.folder, args.python, [pinned(name, pins) for name in OF_SBX], "--pre")
    with tempfile.TemporaryDirectory() as folder:
        download(Path(folder), args.python, [pinned("dm-control", pins)])
        (whole,) = Path(folder).glob("dm_control-*.whl")
        with (
            zipfile.ZipFile(whole) as ours,
            zipfile.ZipFile(args.folder / whole.name, "w", zipfile.ZIP_DEFLATED) as small,
        ):
            for name in ours.namelist():
                if not LEFT_OUT.match(name):
                    small.writestr(name, ours.read(name))
    size = sum(path.stat().st_size for path in args.folder.glob("*.whl")) / 2**20
    print(f"{args.folder}: {size:.0f} MiB")
    if size > LARGEST:
        raise SystemExit(f"that is more than {LARGEST} MiB")


def pinned(name: str, pins: dict[str, str]) -> str:
    """A requirement, with the version of the lock file if it has one."""
    version = {key.lower().replace("_", "-"): value for key, value in pins.items()}.get(name)
    return name if version is None else f"{name}=={version}"


def download(folder: Path, python: str, requirements: list[str], *more: str) -> None:
    """Wheels for Linux and the version of Python, without their dependencies."""
    platforms = [argument for platform in PLATFORMS for argument in ("--platform", platform)]
    options = [*more, "--no-deps", "--only-binary=:all:", "--python-version", python, "--implementation", "cp"]
    command = [sys.executable, "-m", "pip", "download", "--quiet", *options, *platforms, "-d", str(folder)]
    subprocess.run([*command, *requirements], check=True)


if __name__ == "__main__":
    main()
