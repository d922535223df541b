"""Write the locks in requirements/: every package of every extra, with the hashes of PyPI's files.

Usage: `pip install uv && python .ci/lock.py`, after pyproject.toml or constraints.txt has changed. Versions that
neither of them fixes stay as they are; with `--upgrade` they become the newest.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "requirements"
# torch and CUDA are on their own, since many users have another build of torch, with other hashes.
TORCH = re.compile(r"torch==|triton==|nvidia-|cuda-")
EXTRAS = ("viewer", "video", "tensorboard", "flip", "glb", "splats", "usd")  # of users, in run.txt
HEADERS = {
    "torch": "torch and its CUDA libraries.",
    "run": f"What nexwarp and its extras {', '.join(EXTRAS)} need beside torch.txt.",
    "dev": "What the other extras need beside torch.txt and run.txt: tests, documentation, releases.",
}


def resolve(*options: str) -> list[str]:
    """Resolve dependencies for all Pythons and platforms, and return a block of lines for each version."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "lock.txt"  # uv keeps the versions that it finds there
        out.write_text("".join(path.read_text(encoding="utf-8") for path in FOLDER.glob("*.txt")), encoding="utf-8")
        command = ["uv", "pip", "compile", "--quiet", "--universal", "--python-version=3.10", "--generate-hashes"]
        command += ["--no-annotate", "--constraints=constraints.txt", f"--output-file={out}", "pyproject.toml"]
        subprocess.run([*command, *options, *sys.argv[1:]], cwd=ROOT, check=True)
        return re.findall(r"^\w.*?(?=^\w|\Z)", out.read_text(encoding="utf-8"), re.M | re.S)


def main() -> None:
    """Write the three files."""
    FOLDER.mkdir(exist_ok=True)
    users = {block.split("==")[0] for block in resolve(*(f"--extra={extra}" for extra in EXTRAS))}
    texts = {file: f"# {header} Written by .ci/lock.py.\n" for file, header in HEADERS.items()}
    for block in resolve("--all-extras"):
        texts["torch" if TORCH.match(block) else "run" if block.split("==")[0] in users else "dev"] += block
    for file, text in texts.items():
        (FOLDER / f"{file}.txt").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
