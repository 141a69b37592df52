"""Resolve the core wheel for other platforms with binary wheels only, and install nothing.

A Raspberry Pi or a laptop without a compiler can install the core if this succeeds. The tags are
those that pip on such a machine accepts; markers of dependencies are those of this machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHON = "3.11"
LINUX = ("manylinux_2_17", "manylinux2014", "manylinux_2_24", "manylinux_2_26", "manylinux_2_27")
LINUX += ("manylinux_2_28", "manylinux_2_31", "manylinux_2_34")
PLATFORMS = {
    "Linux x86-64": [f"{tag}_x86_64" for tag in LINUX],
    "Linux aarch64": [f"{tag}_aarch64" for tag in LINUX],
    "macOS arm64": [f"macosx_{version}_0_arm64" for version in (11, 12, 13, 14)],
    "Windows x64": ["win_amd64"],
}


def call(*command: str | Path) -> str:
    """Run a command that has to succeed, and return what it printed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))} failed ({done.returncode}):\n{done.stderr}")
    return done.stdout


def resolved(wheel: Path, tags: list[str]) -> list[str]:
    """Return the wheels that pip would install for some platform tags."""
    options = ["--dry-run", "--target", str(wheel.parent / "none"), "--quiet"]
    options += ["--ignore-installed", "--only-binary", ":all:"]
    options += ["--python-version", PYTHON, "--implementation", "cp", "--report", "-"]
    options += [part for tag in tags for part in ("--platform", tag)]
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install"]
    report = json.loads(call(*pip, *options, wheel))
    return [one["download_info"]["url"].rpartition("/")[2] for one in report["install"]]


def main() -> None:
    """Build the wheel and resolve it for each platform."""
    with tempfile.TemporaryDirectory() as folder:
        call(sys.executable, "-m", "build", "--wheel", "--outdir", folder, ROOT)
        (wheel,) = Path(folder).glob("*.whl")
        for name, tags in PLATFORMS.items():
            begun = time.perf_counter()
            found = resolved(wheel, tags)
            native = [one for one in found if not one.endswith("-none-any.whl")]
            if not native:
                sys.exit(f"{name}: no wheel of this platform is among {found}.")
            took = time.perf_counter() - begun
            print(f"{name}: {len(found)} wheels, {len(native)} of the platform ({took:.0f} s)")


if __name__ == "__main__":
    main()
