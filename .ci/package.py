"""Build wheel and source distribution as a release does, and use the wheel as a stranger would.

The wheel is built from the source distribution and once more from the repository: both are the same
to the byte. It holds the package and nothing else. It is installed, with what it needs alone, into
an environment of its own outside the repository, and its command works there.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "livepde"
LARGEST = 2_000_000  # bytes of the wheel


def call(*command: str | Path, **options) -> str:
    """Run a command that has to succeed, and return what it printed."""
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, **options)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))} failed ({done.returncode}):\n{done.stdout}")
    return done.stdout


def build(out: Path, *options: str) -> None:
    """Build into a folder, with the versions of `constraints.txt`."""
    call(sys.executable, "-m", "build", "--outdir", out, *options, ROOT, stderr=subprocess.STDOUT)


def checked(wheel: Path, again: Path) -> str:
    """Return the version of a wheel that holds what it should."""
    if wheel.read_bytes() != again.read_bytes():
        sys.exit(f"{wheel.name}: the source distribution builds another wheel than the repository.")
    if wheel.stat().st_size >= LARGEST:
        sys.exit(f"{wheel.name}: {wheel.stat().st_size} bytes; below {LARGEST} expected.")
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        (metadata,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        version = Parser().parsestr(archive.read(metadata).decode())["Version"]
    files = {
        path.relative_to(PACKAGE.parent).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    if names != files:
        sys.exit(f"{wheel.name}: differs from src/livepde by {', '.join(sorted(names ^ files))}.")
    return version


def used(wheel: Path, version: str, place: Path) -> None:
    """Install a wheel into a new environment and work with it in an empty folder."""
    venv.create(place / "env", with_pip=True)
    programs = place / "env" / ("Scripts" if sys.platform == "win32" else "bin")
    pip = [programs / "python", "-m", "pip", "--disable-pip-version-check"]
    call(*pip, "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel)
    call(*pip, "check")
    work = place / "work"
    work.mkdir()

    def livepde(*arguments: str) -> str:
        return call(programs / "livepde", *arguments, cwd=work)

    told = livepde("--version")
    if told != f"livepde {version}\n":
        sys.exit(f"livepde --version printed {told!r}; the wheel's version is {version}.")
    where = call(programs / "python", "-c", "import livepde; print(livepde.__file__)", cwd=work)
    if not Path(where).is_relative_to(place):
        sys.exit(f"import livepde took {where.strip()}, not the wheel.")
    call(programs / "python", "-W", "error", "-c", "from livepde import *", cwd=work)
    for arguments in ("--help", "citation", "equations", "init case", "check case/case.toml"):
        livepde(*arguments.split())
    livepde("run", "case/case.toml", "--out", "found")
    livepde("report", "found")
    livepde("reproduce", "seed", "--json")


def main() -> None:
    """Do it all, and say what was built."""
    dist = ROOT / "dist"
    for old in dist.glob("livepde-*"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        build(dist)
        build(Path(folder), "--wheel")
        (wheel,), (again,) = dist.glob("*.whl"), Path(folder).glob("*.whl")
        version = checked(wheel, again)
        call(sys.executable, "-m", "twine", "check", "--strict", *sorted(dist.glob("livepde-*")))
        used(wheel, version, Path(folder))
    for path in sorted(dist.glob("livepde-*")):
        print(f"Built: dist/{path.name} ({path.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main()
