"""The locks in requirements/ hold what pyproject.toml and constraints.txt say, with hashes; and the audit."""

import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # a dependency of pytest there

ROOT = Path(__file__).parents[2]
LOCKS = ("torch", "run", "dev")
RUN_EXTRAS = ("viewer", "video", "tensorboard", "flip", "glb", "splats")
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PLATFORMS = (
    {"sys_platform": "linux", "platform_machine": "x86_64"},
    {"sys_platform": "win32"},
    {"sys_platform": "darwin"},
)


def read_lock(name: str) -> list[tuple[Requirement, list[str]]]:
    """Requirements of a lock and their hashes."""
    text = (ROOT / "requirements" / f"{name}.txt").read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.split(" --hash=") for line in text.splitlines() if line[:1].isalnum()]
    return [(Requirement(line[0]), [part.strip() for part in line[1:]]) for line in lines]


def constraints() -> list[Requirement]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


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
    tested, extras = pinned(constraints(), environment), asked()
    for locks, wanted in ((LOCKS[:2], ("", *RUN_EXTRAS)), (LOCKS, tuple(extras))):
        lock = pinned([requirement for name in locks for requirement, _ in read_lock(name)], environment)
        differ = {key: lock[key] for key in lock.keys() & tested.keys() if lock[key] != tested[key]}
        assert not differ and (locks != LOCKS or tested.keys() <= lock.keys())
        for requirement in (requirement for extra in wanted for requirement in extras[extra]):
            version = lock[canonicalize_name(requirement.name)].removeprefix("==")
            assert requirement.specifier.contains(version), f"{locks}: {requirement} is {version}"


def test_a_vulnerability_fails_the_audit() -> None:
    """And an audit that skipped everything is none."""
    spec = importlib.util.spec_from_file_location("audit", ROOT / ".ci" / "audit.py")
    assert spec is not None and spec.loader is not None
    audit = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(audit)
    bad = {"name": "numpy", "version": "1.0", "vulns": [{"id": "CVE-1", "fix_versions": ["1.1", "2.0"]}]}
    good = {"name": "torch", "version": "2.0", "vulns": []}
    skipped = {"name": "rich", "skip_reason": "no answer"}
    passed = audit.judge("osv", json.dumps({"dependencies": [good, skipped]}))
    assert passed == (0, "audited 1 of 2 packages with osv: 0 vulnerabilities")
    code, text = audit.judge("osv", json.dumps({"dependencies": [good, bad]}))
    assert code == 1 and text.startswith("numpy 1.0: CVE-1, fixed in 1.1, 2.0\n")
    assert audit.judge("pypi", json.dumps({"dependencies": [skipped]})) is None and audit.judge("osv", "") is None
