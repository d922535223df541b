"""Installation: an editable package is found from every folder, and metadata on PyPI is complete."""

import importlib.util
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import nexwarp

ROOT = Path(__file__).parents[2]


def build_editable(clone: Path, folder: Path) -> Path:
    pytest.importorskip("setuptools", reason="needs setuptools (extra dev)")
    code = f"import setuptools.build_meta as b; b.build_editable({str(folder)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=clone, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A clone whose folder is named as the package, with a package of one line."""
    clone = tmp_path / "nexwarp"
    (clone / "nexwarp").mkdir(parents=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, clone)
    (clone / "nexwarp" / "__init__.py").write_text("render = 'the function'\n")
    (clone / "nexwarp" / "py.typed").touch()
    return clone


def test_an_editable_package_is_found_in_the_folder_above_the_clone(clone: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    with zipfile.ZipFile(build_editable(clone, site)) as wheel:
        wheel.extractall(site)
    for folder in (tmp_path, clone, clone / "nexwarp", site):
        # Without the site-packages of this environment (-S), which hold another nexwarp.
        code = f"import site; site.addsitedir({str(site)!r}); import nexwarp; print(nexwarp.render)"
        done = subprocess.run([sys.executable, "-S", "-c", code], cwd=folder, capture_output=True, text=True, env={})
        assert (done.stdout, done.stderr) == ("the function\n", ""), folder


def test_the_version_has_one_value() -> None:
    written = re.search(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M)
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M)
    assert written is not None and cited is not None
    assert written[1] == cited[1] == nexwarp.__version__


def test_the_readme_on_pypi_links_to_files_that_exist() -> None:
    spec = importlib.util.spec_from_file_location("package", ROOT / ".ci" / "package.py")
    assert spec is not None and spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    text = package.absolute_links((ROOT / "README.md").read_text(encoding="utf-8"))
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    assert targets and all(re.match(r"https?://|#", target) for target in targets)
    ours = re.findall(r"https://(?:raw\.)?github\w*\.com/nexwarp/nexwarp/(?:blob/)?main/([^)#\s]+)", text)
    assert "docs/capture.jpg" in ours and all((ROOT / name).exists() for name in ours)
