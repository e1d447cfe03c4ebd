"""What the hosting site reads (.github, CITATION.cff), and what the Makefile installs from."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[3]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
FORMS = sorted(p for p in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if p.name != "config.yml")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def triggers(workflow: dict) -> dict:
    return workflow[True]  # YAML 1.1 reads the key `on` as a truth value


def steps(workflow: dict) -> list[dict]:
    return [step for job in workflow["jobs"].values() for step in job["steps"]]


def canonical(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", re.match(r"[A-Za-z0-9._-]+", requirement)[0]).lower()


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda p: p.stem)
def test_a_workflow_runs_the_makefile_and_nothing_else(path):
    targets = set(re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.M)[1].split())
    runs = [step["run"] for step in steps(yaml.safe_load(path.read_text())) if "run" in step]
    assert runs
    for command in runs:
        assert re.fullmatch(r"make [a-z]+", command), command
        assert command.split()[1] in targets, command


def test_every_supported_python_is_tested_on_both_processors_each_night():
    workflow = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text())
    assert {"push", "pull_request", "schedule"} <= set(triggers(workflow))
    matrix = workflow["jobs"]["test"]["strategy"]["matrix"]
    assert matrix["python"] == ["3.11", "3.12", "3.13", "3.14"]
    assert sorted("arm" in runner for runner in matrix["runner"]) == [False, True]
    assert {"make check", "make test", "make docs"} <= {step.get("run") for step in steps(workflow)}


def test_a_tag_keeps_wheel_and_sdist():
    workflow = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())
    assert triggers(workflow)["push"] == {"tags": ["v*"]}
    assert "make dist" in [step.get("run") for step in steps(workflow)]
    assert any(step.get("with", {}).get("path") == "dist/" for step in steps(workflow))


@pytest.mark.parametrize("path", FORMS, ids=lambda p: p.stem)
def test_a_form_has_what_the_site_requires(path):
    form = yaml.safe_load(path.read_text())
    assert form["name"]
    assert form["description"]
    names = [entry["id"] for entry in form["body"]]
    assert len(set(names)) == len(names)
    for entry in form["body"]:
        assert entry["type"] in {"input", "textarea", "dropdown"}
        assert entry["attributes"]["label"]


def test_the_bug_form_asks_for_the_check():
    assert "vical check -c vical.yaml --json" in (ROOT / ".github/ISSUE_TEMPLATE/bug.yml").read_text()


def test_the_citation_names_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
    assert {"cff-version", "message", "title", "authors"} <= set(citation)


def test_constraints_pin_every_requirement_and_name_no_index():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line[:1] != "#"]
    assert all(re.match(r"[a-z0-9-]+==[^ ]+( ; .+)?$", line) for line in lines)
    pinned = {canonical(line) for line in lines}
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    assert {canonical(r) for group in groups for r in group} - {"vical"} <= pinned


def test_a_user_installs_nothing_for_tests_checks_or_documentation():
    user = {canonical(r) for r in PROJECT["dependencies"]}
    for group in ("test", "check", "docs", "dist"):
        assert not user & {canonical(r) for r in PROJECT["optional-dependencies"][group]}


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("group", ["user", "test", "check", "docs", "dist"])
def test_each_group_has_a_stamp_of_its_own(group):
    wanted = "--editable '.'" if group == "user" else f"--editable '.[{group}]'"
    assert wanted in run("make", "-n", "-B", f".venv/.{group}").stdout


@pytest.mark.parametrize(("target", "group"), [("demo", "user"), ("test", "test")])
def test_neither_of_the_two_commands_installs_a_tool_for_developers(target, group):
    assert re.findall(r"Installing into .venv: (\w+)", run("make", "-n", "-B", target).stdout) == [group]


@pytest.mark.parametrize(("options", "code"), [([], 0), (["-W", "error"], 1)], ids=["user", "ci"])
def test_a_deprecation_fails_in_ci_and_not_for_a_user(tmp_path, options, code):
    file = tmp_path / "test_old.py"
    file.write_text("import warnings\n\ndef test_old():\n    warnings.warn('going', DeprecationWarning)\n")
    done = run(
        *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options),
        *("-c", str(ROOT / "pyproject.toml"), "--rootdir", str(tmp_path), str(file)),
    )
    assert done.returncode == code, done.stdout
    assert "DeprecationWarning: going" in done.stdout


def test_ci_raises_deprecations_and_sets_the_usual_limits():
    script = (ROOT / ".ci/run").read_text()
    assert "test PYTEST_ARGS='-W error'" in script
    assert "ulimit -l 8192" in script
    assert "ulimit -S -n 1024" in script
    assert run("bash", "-n", ".ci/run").returncode == 0


@pytest.mark.parametrize(("failing", "code"), [("none", 0), ("check", 1), ("test", 1), ("root", 1)])
def test_ci_checks_next_to_the_tests_and_fails_with_any(failing, code):
    """With a `make` that only says what it is to do. Root comes last: where it writes, nobody else may."""
    functions = re.findall(r"^\w+\(\) \{.*?^\}$", (ROOT / ".ci/run").read_text(), re.M | re.S)
    stub = f'make() {{ echo "make $1"; sleep 0.2; [[ $1 != {failing} ]]; }}'
    root = f"root_tests() {{ echo 'root tests'; [[ root != {failing} ]]; }}"
    words = [*functions, "settings=()", stub, root, 'as_user() { "$@"; }', "run_all as_user"]
    done = run("bash", "-euo", "pipefail", "-c", "\n".join(words))
    assert done.returncode == code, done.stderr
    said = done.stdout.split("\n")
    assert said[0] == "make .venv/.check"  # one pip at a time, and before anything uses what it changes
    assert {"make check", "make test"} <= set(said)
    assert said.index("make check") < said.index("root tests")
    assert ("make check FAILED; the tests go on" in said) == (failing == "check")


def test_the_image_is_made_of_what_a_wheel_is_made_of():
    """What `pip install .` reads goes into the build of the Containerfile, and nothing that is not there."""
    let_in = {
        line[1:] for line in (ROOT / ".containerignore").read_text().splitlines() if line.startswith("!")
    }
    assert all((ROOT / name).exists() for name in let_in)
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = [*wheel["packages"], *wheel["force-include"], PROJECT["readme"], "pyproject.toml"]
    assert {path.split("/")[0] for path in needed} <= let_in
    recipe = (ROOT / "Containerfile").read_text()
    copied = re.findall(r"^COPY (?!--from)(\S+) ", recipe, re.M)
    assert copied and all(name == "." or name in let_in for name in copied)
    assert "-c /src/constraints.txt" in recipe and "constraints.txt" in let_in
