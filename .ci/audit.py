"""Ask OSV, then PyPI, for known vulnerabilities of the versions that users install.

Usage: `python .ci/audit.py`. It exits with 1 if there are any, and says so where no service answers: pip-audit alone
reports "No known vulnerabilities found" after it has skipped every package.
"""

import json
import subprocess
import sys
from pathlib import Path

LOCKS = [Path(__file__).parents[1] / "requirements" / f"{name}.txt" for name in ("torch", "run")]


def judge(service: str, report: str) -> tuple[int, str] | None:
    """Exit code and text for pip-audit's JSON report; None if the service has told nothing."""
    try:
        packages = json.loads(report)["dependencies"]
    except json.JSONDecodeError:
        return None
    audited = [package for package in packages if "vulns" in package]
    if not audited:
        return None
    lines = []
    for package in audited:
        for vulnerability in package["vulns"]:
            fixed = ", ".join(vulnerability["fix_versions"]) or "no version"
            lines.append(f"{package['name']} {package['version']}: {vulnerability['id']}, fixed in {fixed}")
    summary = f"audited {len(audited)} of {len(packages)} packages with {service}: {len(lines)} vulnerabilities"
    return int(bool(lines)), "\n".join([*lines, summary])


def main() -> int:
    """Print the first answer."""
    for service in ("osv", "pypi"):
        command = [sys.executable, "-m", "pip_audit", "--require-hashes", "--disable-pip"]
        command += [f"--requirement={lock}" for lock in LOCKS]
        command += ["--vulnerability-service", service, "--timeout", "10", "--progress-spinner", "off"]
        done = subprocess.run([*command, "--format", "json"], capture_output=True, text=True)
        answer = judge(service, done.stdout)
        if answer:
            print(answer[1])
            return answer[0]
    print("audit SKIPPED: neither OSV nor PyPI's data of vulnerabilities can be reached from here")
    return 0


if __name__ == "__main__":
    sys.exit(main())
