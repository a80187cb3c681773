"""Mutation testing: how many small wrong changes of the code do its tests notice?

    make mutants                            a seeded sample of tools/mutants.toml, 200 mutants or more
    make mutants ARGS="--only checks"       one group of modules
    make mutants ARGS="--sample 20 --seed 1"

cosmic-ray writes the mutants, each in a copy of the checkout, and runs the tests that tools/mutants.toml
names for the module. A sample takes places of the code, then one mutant at each. Results are kept as they
come: a run that was interrupted goes on where it stopped, and survivors are tried again when their tests
have changed. Survivors are printed with the judgement that the file holds of them; those that give the same
answers as the code ("same") can't be killed and don't count. Exit code 1 where fewer than nine in ten of the
others are killed, or a survivor is not judged.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import re
import shlex
import shutil
import sys
import tempfile
import time
import tomllib
import warnings
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test, mutate_code
from cosmic_ray.plugins import get_operator
from cosmic_ray.testing import run_tests
from cosmic_ray.work_db import WorkDB
from cosmic_ray.work_item import MutationSpec, TestOutcome

ROOT = Path(__file__).resolve().parents[1]
PYTHON = ROOT / ".venv/bin/python"
LEFT_OUT = (".git", ".venv", ".mutants", "runs", "__pycache__", ".hypothesis", "*.ipynb")
# unions of types are no computation, and decorators are mostly jit: without it the same comes slower
NO_MUTANTS = re.compile("core/(ReplaceBinaryOperator_BitOr_|RemoveDecorator|Variable)")
CACHE = "JAX_COMPILATION_CACHE_DIR"
WANTED = 0.9  # of the mutants killed


def mutants_of(modules: list[str]) -> list[MutationSpec]:
    with tempfile.TemporaryDirectory() as folder:
        work = WorkDB(Path(folder) / "work.sqlite", WorkDB.Mode.create)
        init([Path(module) for module in modules], work, {})
        found = [item.mutations[0] for item in work.work_items]
        work.close()
    return [each for each in found if not NO_MUTANTS.match(each.operator_name)]


def sample(mutants: list[MutationSpec], count: int, seed: int) -> list[MutationSpec]:
    """One mutant at each of so many places, the same for the same code and seed; none that is no Python."""
    at = {}
    for each in mutants:
        at.setdefault((str(each.module_path), each.start_pos), []).append(each)
    chance = random.Random(seed)
    places, chosen = sorted(at), []
    chance.shuffle(places)
    for place in places:
        ones = sorted(at[place], key=lambda mutant: (mutant.operator_name, mutant.occurrence))
        chance.shuffle(ones)
        chosen += [one for one in ones if is_python(one)][:1]
        if len(chosen) == count:
            break
    return chosen


def is_python(mutant: MutationSpec) -> bool:
    """A star of a signature that became a minus kills every test: that does not count."""
    operator = get_operator(mutant.operator_name)(**mutant.operator_args)
    code = mutate_code(Path(mutant.module_path).read_text(), operator, mutant.occurrence)
    with warnings.catch_warnings(action="ignore"):
        try:
            compile(code, "mutant", "exec")
        except SyntaxError:
            return False
    return True


def command_for(tests: str) -> str:
    return f"{shlex.quote(str(PYTHON))} -m pytest -x -q -n 0 -p no:cacheprovider {tests}"


def in_own_copy(copies: multiprocessing.Queue) -> None:
    """Every worker stands in a checkout of its own, and compiles in haste what was not compiled before."""
    copy = copies.get()
    os.chdir(copy)
    os.environ |= {
        "PYTHONPATH": copy,
        "CI": "1",
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        CACHE: f"{copy}/.compiled",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    }


def clean_seconds(tests: str) -> float:
    began = time.monotonic()
    outcome, said = run_tests(command_for(tests), 1800)
    if outcome != TestOutcome.SURVIVED:
        sys.exit(f"without a mutant these fail already: {tests}\n{said[-2000:]}")
    return time.monotonic() - began


def tried(job: tuple[str, MutationSpec, str, float]) -> dict:
    group, mutant, tests, limit = job
    began = time.monotonic()
    result = mutate_and_test([mutant], command_for(tests), limit)
    if result.test_outcome == TestOutcome.KILLED and not re.search("failed|error|timeout", result.output):
        shutil.rmtree(os.environ[CACHE], ignore_errors=True)  # the process died of it: that does not count
        result = mutate_and_test([mutant], command_for(tests), limit)
    lines = (result.diff or result.output).splitlines()
    return {
        "group": group,
        "key": key_of(mutant),
        "tests": digest(tests.split()),
        "place": f"{mutant.module_path}:{mutant.start_pos[0]}",
        "was": "\n".join(line[1:].strip() for line in lines if re.match(r"-(?!--)", line)),
        "becomes": "\n".join(line[1:].strip() for line in lines if re.match(r"\+(?!\+\+)", line)),
        "outcome": str(result.test_outcome.value if result.test_outcome else "none"),
        "seconds": round(time.monotonic() - began, 1),
    }


def key_of(mutant: MutationSpec) -> str:
    return f"{digest([mutant.module_path])} {mutant.operator_name} {mutant.occurrence}"


def digest(files: list[str]) -> str:
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()[:16]


def show(groups: list[dict], results: list[dict], judged: list[dict]) -> int:
    killed = lambda some: sum(each["outcome"] == "killed" for each in some)
    print(f"\n{'group':<14}{'mutants':>8}{'killed':>8}")
    for group in groups:
        own = [each for each in results if each["group"] == group["name"]]
        print(f"{group['name']:<14}{len(own):>8}{killed(own):>8}")
    unjudged, same = 0, 0
    survivors = [each for each in results if each["outcome"] != "killed"]
    for each in survivors:
        found = [one for one in judged if (one["was"], one["becomes"]) == (each["was"], each["becomes"])]
        each["why"] = found[0]["why"] if found else "not judged yet"
        unjudged += not found
        same += bool(found and found[0].get("same"))
    share = killed(results) / max(len(results) - same, 1)
    print(f"{'all':<14}{len(results):>8}{killed(results):>8}   {killed(results) / max(len(results), 1):.1%}")
    print(f"{same} of the {len(survivors)} survivors give the same answers; of the others killed {share:.1%}")
    for each in survivors:
        print(f"\n{each['place']} {each['outcome']}: {each['why']}")
        print(f"  - {each['was']}\n  + {each['becomes']}")
    return int(share < WANTED or unjudged > 0)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sample", type=int, metavar="N", help="mutants of each group")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="GROUP", help="one group")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time (2)")
    options = parser.parse_args()
    config = tomllib.loads((ROOT / "tools/mutants.toml").read_text())
    groups = [group for group in config["group"] if options.only in (None, group["name"])]
    os.chdir(ROOT)
    kept = Path(".mutants/results.jsonl")
    kept.parent.mkdir(exist_ok=True)
    known = {each["key"]: each for each in map(json.loads, kept.open())} if kept.exists() else {}
    results, queue = [], []
    for group in groups:
        chosen = sample(mutants_of(group["modules"]), options.sample or group["sample"], options.seed)
        now = digest(group["tests"].split())
        for each in chosen:
            found = known.get(key_of(each))
            if found and (found["outcome"] == "killed" or found["tests"] == now):
                results.append(found)
            else:
                queue.append((group, each))
    with tempfile.TemporaryDirectory(prefix="pk_jax_mutants_") as folder, kept.open("a") as file:
        copies = multiprocessing.Queue()
        for i in range(options.jobs):
            copy = f"{folder}/{i}"
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT))
            copies.put(copy)
        with multiprocessing.Pool(options.jobs, in_own_copy, [copies]) as pool:
            needed = list(dict.fromkeys(group["tests"] for group, _ in queue))
            limits = {t: 30 + 4 * s for t, s in zip(needed, pool.map(clean_seconds, needed, 1), strict=True)}
            jobs = [(g["name"], mutant, g["tests"], limits[g["tests"]]) for g, mutant in queue]
            for i, result in enumerate(pool.imap_unordered(tried, jobs), 1):
                file.write(json.dumps(result) + "\n")
                file.flush()
                results.append(result)
                print(
                    f"[{i}/{len(jobs)}] {result['outcome']} {result['place']} {result['seconds']} s",
                    flush=True,
                )
    return show(groups, results, config.get("judged", []))


if __name__ == "__main__":
    sys.exit(main())
