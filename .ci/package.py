"""Build the sdist, the wheel and the SBOM of the last commit.

Usage: `python .ci/package.py FOLDER`. One commit gives the same bytes in every folder and under every umask.
setuptools and the other tools are those of this environment, which `constraints.txt` pins.
"""

import gzip
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


REPOSITORY = "nexwarp/nexwarp"


def absolute_links(text: str) -> str:
    """Return the README with links to the repository's files that work on PyPI, too; pictures link to their content."""

    def absolute(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        base = f"raw.githubusercontent.com/{REPOSITORY}/main" if picture else f"github.com/{REPOSITORY}/blob/main"
        return f"{picture}[{words}](https://{base}/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", absolute, text)


def run(*command: str | Path, stdin: bytes = b"") -> bytes:
    """Run a command in the repository, and return what it writes to standard output."""
    return subprocess.run(command, cwd=ROOT, check=True, input=stdin, stdout=subprocess.PIPE).stdout


def build(kind: str, source: Path, folder: Path) -> Path:
    """Build one distribution with the setuptools of this environment."""
    before = set(folder.glob("*"))
    run(sys.executable, "-m", "build", f"--{kind}", "--no-isolation", "--outdir", folder, source)
    (built,) = set(folder.glob("*")) - before
    return built


def normalise(sdist: Path, time: int) -> None:
    """Give the files of an sdist one order, owner and time, and modes that depend on git alone."""
    content = io.BytesIO()
    with tarfile.open(sdist) as old, tarfile.open(fileobj=content, mode="w", format=tarfile.PAX_FORMAT) as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            plain = tarfile.TarInfo(member.name)
            plain.type, plain.size, plain.mtime = member.type, member.size, time
            plain.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            new.addfile(plain, old.extractfile(member))
    sdist.write_bytes(gzip.compress(content.getvalue(), mtime=time))


def write_sbom(source: Path, file: Path) -> None:
    """Write the dependencies with their hashes as CycloneDX JSON, validated against its schema."""
    locks = b"".join((source / "requirements" / name).read_bytes() for name in ("torch.txt", "run.txt"))
    command = [sys.executable, "-W", "ignore::UserWarning", "-m", "cyclonedx_py", "requirements"]
    command += ["--validate", "--output-reproducible", "--output-format", "JSON", "--mc-type", "library"]
    run(*command, "--output-file", file, "--pyproject", source / "pyproject.toml", "-", stdin=locks)


def main(folder: Path) -> None:
    """Build all three into an empty folder."""
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    time = int(run("git", "log", "-1", "--format=%ct"))
    os.environ["SOURCE_DATE_EPOCH"] = str(time)
    os.umask(0o022)
    with tempfile.TemporaryDirectory() as work:
        source, unpacked = Path(work, "source"), Path(work, "unpacked")
        with tarfile.open(fileobj=io.BytesIO(run("git", "archive", "HEAD"))) as archive:
            archive.extractall(source, filter="data")
        readme = source / "README.md"
        readme.write_text(absolute_links(readme.read_text(encoding="utf-8")), encoding="utf-8")
        sdist = build("sdist", source, folder)
        normalise(sdist, time)
        with tarfile.open(sdist) as archive:
            archive.extractall(unpacked, filter="data")
        wheel = build("wheel", next(unpacked.iterdir()), folder)
        write_sbom(source, folder / f"{'-'.join(wheel.name.split('-')[:2])}.cdx.json")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
