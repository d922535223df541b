"""Execute the notebooks, each in a fresh kernel, and keep their outputs: `python -m notebooks --help`."""

import argparse
import asyncio
import base64
import hashlib
import io
import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image

from nexwarp.io.files import written_aside

FOLDER = Path(__file__).resolve().parent
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
JPEG_QUALITY = 88
MINUTES = 30  # for one cell, at most
NO_DRIVER = "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"  # written by Warp's C code, always


def sources(notebook: nbformat.NotebookNode) -> str:
    """Digest of the code that a notebook's outputs were made of: another one shows that they are stale."""
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return hashlib.sha256("\0".join(code).encode()).hexdigest()


def pictures(notebook: nbformat.NotebookNode) -> list[int]:
    """How many pictures each cell of code gives."""
    return [sum("data" in output for output in cell.outputs) for cell in notebook.cells if cell.cell_type == "code"]


def execute(source: Path, target: Path) -> None:
    """Run a notebook in its own folder from the first cell to the last, and write it with its outputs.

    Raises:
        RuntimeError: a cell fails, or writes to stderr, as warnings do.
    """
    notebook = nbformat.read(source, as_version=4)
    client = NotebookClient(
        notebook,
        timeout=60 * MINUTES,
        kernel_name="python3",
        extra_arguments=["--log-level=ERROR"],
        record_timing=False,
        resources={"metadata": {"path": str(source.parent)}},
    )
    try:
        client.execute()
    except CellExecutionError as error:
        raise RuntimeError(f"{source.name}: {error}") from None
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if not _no_driver(output)]
            for output in cell.outputs:
                _shrink(output)
                if output.get("name") == "stderr":
                    raise RuntimeError(f"{source.name}: expected nothing on stderr, got {output.text}")
    notebook.metadata = {key: notebook.metadata[key] for key in ("kernelspec", "language_info")}
    notebook.metadata["language_info"] = {"name": "python"}  # and no versions, which differ from machine to machine
    notebook.metadata["sources"] = sources(notebook)
    with written_aside(target) as temporary:
        nbformat.write(notebook, temporary)


def _no_driver(output: nbformat.NotebookNode) -> bool:
    """Whether an output is no more than Warp's note that the machine has no GPU."""
    lines = output.text.strip().splitlines() if output.get("name") == "stderr" else [""]
    return all(line.startswith(NO_DRIVER) for line in lines)


def _shrink(output: nbformat.NotebookNode) -> None:
    """Make a PNG a JPEG where that takes less than 0.6 of it: photos, not plots."""
    png = output.get("data", {}).get("image/png")
    if png is None:
        return
    jpeg = io.BytesIO()
    Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB").save(jpeg, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    text = base64.b64encode(jpeg.getvalue()).decode()
    if len(text) < 0.6 * len(png):
        del output.data["image/png"]
        output.data["image/jpeg"] = text


def main(arguments: list[str] | None = None) -> int:
    """Execute notebooks in order; 1 when one fails."""
    parser = argparse.ArgumentParser(prog="python -m notebooks", description="Execute the notebooks, outputs kept.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; all by default")
    parser.add_argument("--out", type=Path, help="folder to write to (default: in place)")
    given = parser.parse_args(arguments)
    if unknown := sorted(set(given.names) - set(NAMES)):
        parser.error(f"NAME: expected some of {', '.join(NAMES)}, got {', '.join(unknown)}")
    # The kernels inherit these: the package beside this folder, installed or not.
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(FOLDER.parent), os.environ.get("PYTHONPATH")]))
    if sys.platform == "win32":
        asyncio.set_event_loop_policy(asyncio.WindowsSelectorEventLoopPolicy())
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names or NAMES:
        start = time.perf_counter()
        source, target = ((folder / f"{name}.ipynb") for folder in (FOLDER, given.out or FOLDER))
        try:
            execute(source, target)
            kept, made = (pictures(nbformat.read(path, as_version=4)) for path in (source, target))
            if kept != made:
                raise RuntimeError(f"{name}: expected as many pictures as the kept outputs have, {kept}, got {made}")
        except RuntimeError as error:
            print(f"{name}: FAILED\n{error}", file=sys.stderr)
            return 1
        print(f"{name}: {time.perf_counter() - start:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
