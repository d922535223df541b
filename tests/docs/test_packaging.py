"""Packaging: an editable package is found from every folder; metadata, locks and audit are complete.

The locks in requirements/ hold what pyproject.toml and constraints.txt say, with hashes.
"""

import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import nexwarp

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # a dependency of pytest there

ROOT = Path(__file__).parents[2]
LOCKS = ("torch", "run", "dev")
RUN_EXTRAS = ("viewer", "video", "tensorboard", "flip", "glb", "splats")
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
LINUX = {"sys_platform": "linux", "platform_machine": "x86_64"}
PLATFORMS = (LINUX, {"sys_platform": "win32"}, {"sys_platform": "darwin"})


def test_an_editable_package_is_found_in_the_folder_above_the_clone(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", reason="needs setuptools (extra dev)")
    clone, site = tmp_path / "nexwarp", tmp_path / "site"
    (clone / "nexwarp").mkdir(parents=True)
    site.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, clone)
    (clone / "nexwarp" / "__init__.py").write_text("render = 'the function'\n")
    (clone / "nexwarp" / "py.typed").touch()
    code = f"import setuptools.build_meta as b; b.build_editable({str(site)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=clone, check=True, capture_output=True)
    (wheel,) = site.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        content.extractall(site)
    for folder in (tmp_path, clone, clone / "nexwarp", site):
        # Without the site-packages of this environment (-S), which hold another nexwarp.
        code = f"import site; site.addsitedir({str(site)!r}); import nexwarp; print(nexwarp.render)"
        done = subprocess.run([sys.executable, "-S", "-c", code], cwd=folder, capture_output=True, text=True, env={})
        assert (done.stdout, done.stderr) == ("the function\n", ""), folder


def test_the_version_has_one_value() -> None:
    written = re.search(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M)
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M)
    assert written is not None and cited is not None and written[1] == cited[1] == nexwarp.__version__


def test_the_readme_on_pypi_links_to_files_that_exist() -> None:
    links = runpy.run_path(str(ROOT / ".ci" / "package.py"))["absolute_links"]
    text = links((ROOT / "README.md").read_text(encoding="utf-8"))
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    assert targets and all(re.match(r"https?://|#", target) for target in targets)
    ours = re.findall(r"https://(?:raw\.)?github\w*\.com/nexwarp/nexwarp/(?:blob/)?main/([^)#\s]+)", text)
    assert "docs/capture.jpg" in ours and all((ROOT / name).exists() for name in ours)


def read_lock(name: str) -> list[tuple[Requirement, list[str]]]:
    text = (ROOT / "requirements" / f"{name}.txt").read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.split(" --hash=") for line in text.splitlines() if line[:1].isalnum()]
    return [(Requirement(line[0]), [part.strip() for part in line[1:]]) for line in lines]


def asked() -> dict[str, list[Requirement]]:
    """Dependencies by extra; "" has those without one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lists = {"": project["dependencies"], **project["optional-dependencies"]}
    return {name: [Requirement(text) for text in texts] for name, texts in lists.items()}


def pinned(requirements: list[Requirement], environment: dict[str, str]) -> dict[str, str]:
    """Versions by name that hold in an environment."""
    valid = [r for r in requirements if r.marker is None or r.marker.evaluate(environment)]
    assert len(valid) == len({canonicalize_name(r.name) for r in valid}), "a package has two versions"
    return {canonicalize_name(r.name): str(r.specifier) for r in valid}


@pytest.mark.parametrize("name", LOCKS)
def test_every_line_has_one_version_and_hashes(name: str) -> None:
    lock = read_lock(name)
    assert len(lock) > 10
    for requirement, hashes in lock:
        assert re.fullmatch(r"==[\w.!+]+", str(requirement.specifier)), requirement
        assert hashes and all(re.fullmatch(r"sha256:[0-9a-f]{64}", each) for each in hashes), requirement


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("platform", PLATFORMS, ids=lambda platform: platform["sys_platform"])
def test_locks_are_the_constraints(python: str, platform: dict[str, str]) -> None:
    """On every Python and platform: the tested versions, and all that pyproject.toml asks for; else run .ci/lock.py."""
    versions = {"python_version": python, "python_full_version": f"{python}.20", "implementation_name": "cpython"}
    environment = {name: str(value) for name, value in default_environment().items()} | versions | platform
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    constraints = [Requirement(line) for line in lines if line and not line.startswith("#")]
    tested, extras = pinned(constraints, environment), asked()
    for locks, wanted in ((LOCKS[:2], ("", *RUN_EXTRAS)), (LOCKS, tuple(extras))):
        lock = pinned([requirement for name in locks for requirement, _ in read_lock(name)], environment)
        differ = {key: lock[key] for key in lock.keys() & tested.keys() if lock[key] != tested[key]}
        assert not differ and (locks != LOCKS or tested.keys() <= lock.keys())
        for requirement in (requirement for extra in wanted for requirement in extras[extra]):
            if requirement.marker is not None and not requirement.marker.evaluate(environment):
                continue
            version = lock[canonicalize_name(requirement.name)].removeprefix("==")
            assert requirement.specifier.contains(version), f"{locks}: {requirement} is {version}"
