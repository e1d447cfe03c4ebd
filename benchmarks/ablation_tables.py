"""Tables of `benchmarks ablation`: each mechanism's figures and those of the estimation as it is."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

Rows = dict[tuple[str, int], dict[str, Any]]  # result by case and seed
_DOF = 7


def print_tables(rows: list[dict[str, Any]], nothing: str) -> None:
    """One table for each kind of data."""
    by: dict[str, dict[str, Rows]] = defaultdict(lambda: defaultdict(dict))
    for r in rows:
        by[r["data"]][r["mechanism"]][r["case"], r["seed"]] = r["result"]
    for data, mechanisms in by.items():
        if nothing not in mechanisms:
            continue
        print(f"\n## {data}\n")
        if data == "euroc":
            _euroc(mechanisms, nothing)
        elif data in ("faults", "free_faults", "free_recordings"):
            for case in dict.fromkeys(c for c, _ in mechanisms[nothing]):
                part = {m: {k: v for k, v in r.items() if k[0] == case} for m, r in mechanisms.items()}
                print(f"\n### {case}\n")
                _rigs({m: r for m, r in part.items() if r}, nothing)
        elif "disturbances" in data:
            _disturbances(mechanisms, nothing)
        else:
            _rigs(mechanisms, nothing)


def _euroc(mechanisms: dict[str, Rows], nothing: str) -> None:
    print(
        "| without | "
        + " | ".join(f"{m}: mm, us, largest z (lens z)" for m in ("fixed", "free", "tracks"))
        + " |"
    )
    print("|---|---|---|---|")
    for name in [nothing, *(m for m in mechanisms if m != nothing)]:
        cells = []
        for mode in ("fixed", "free", "tracks"):
            r = mechanisms[name].get((mode, 0))
            if r is None:
                cells.append("")
            elif "failed" in r:
                cells.append(f"fails: {r['failed']}")
            else:
                lens = f" ({r['lens_z'][0]:.1f} / {r['lens_z'][1]:.1f})" if any(r["lens_z"]) else ""
                cells.append(f"{r['arm_mm']:.2f}, {r['shift_us']:.0f}, {r['z']:.1f}{lens}")
        print(f"| {name} | {' | '.join(cells)} |")


def _rigs(mechanisms: dict[str, Rows], nothing: str) -> None:
    print(
        "| without | rigs | error | sigma | NEES/7: end, all | beyond 3 sigma, 5 sigma % "
        "| converged s | wrong while converged | CPU |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    base = mechanisms[nothing]
    for name in [nothing, *(m for m in mechanisms if m != nothing)]:
        both = [(mechanisms[name][k], base[k]) for k in base if k in mechanisms[name]]
        failed = sum("failed" in r for r, _ in both)
        good = [(r, b) for r, b in both if r.get("t_s") and b.get("t_s")]
        if not good:
            print(f"| {name} | 0/{len(both)}, {failed} fail | | | | | | | |")
            continue
        error, sigma, nees, beyond, wrong, converged, cpu = [], [], [], [], 0, [], []
        for r, b in good:
            e, s = (np.array(r[k])[:, :_DOF] for k in ("error", "sigma"))
            be, bs = (np.array(b[k])[:, :_DOF] for k in ("error", "sigma"))
            error.append([np.mean((e[-1] / bs[-1]) ** 2), np.mean((be[-1] / bs[-1]) ** 2)])
            sigma.append(np.mean(np.log(s[-1] / bs[-1])))
            nees.append([r["nees"][-1] / _DOF, np.mean(r["nees"]) / _DOF])
            z = np.abs(e) / s
            beyond.append([np.mean(z > 3.0), np.mean(z > 5.0)])
            status = np.array([x == "converged" for x in r["status"]])
            wrong += bool((status & (z > 5.0).any(axis=1)).any())
            converged.append(r["t_s"][int(status.argmax())] if status.any() else np.inf)
            cpu.append(np.log(r["cpu_s"] / b["cpu_s"]))
        ratio = np.sqrt(np.mean(np.array(error)[:, 0]) / np.mean(np.array(error)[:, 1]))
        end, every = np.mean(nees, axis=0)
        three, five = 100.0 * np.mean(beyond, axis=0)
        fails = f", {failed} fail" if failed else ""
        print(
            f"| {name} | {len(good)}/{len(both)}{fails} | {ratio:.2f} | {np.exp(np.mean(sigma)):.2f} "
            f"| {end:.2f}, {every:.2f} | {three:.1f}, {five:.2f} | {np.median(converged):.0f} "
            f"({int(np.isinf(converged).sum())} never) | {wrong} | {np.exp(np.mean(cpu)):.2f} |"
        )


def _disturbances(mechanisms: dict[str, Rows], nothing: str) -> None:
    print(
        "| without | runs | found | false | beyond 3 sigma at the end | wrong while converged "
        "| what differs (found, false, largest z at the end) |"
    )
    print("|---|---|---|---|---|---|---|")
    base = mechanisms[nothing]
    for name in [nothing, *(m for m in mechanisms if m != nothing)]:
        rows = {k: r for k, r in mechanisms[name].items() if "failed" not in r}
        found = [r["found"] for r in rows.values() if r["found"] is not None]
        false = sum(bool(r["false"]) for r in rows.values())
        differs = []
        for case in dict.fromkeys(c for c, _ in base):
            was, now = (_case(x, case) for x in (base, rows))
            if name != nothing and now is not None and was is not None and now[:3] != was[:3]:
                differs.append(f"{case}: {_words(was)} -> {_words(now)}")
        print(
            f"| {name} | {len(rows)} | {sum(found)}/{len(found)} | {false} "
            f"| {sum(r['end_z'] > 3.0 for r in rows.values())} "
            f"| {sum(bool(r['lies']) for r in rows.values())} | {'; '.join(differs)} |"
        )


def _case(rows: Rows, case: str) -> tuple[int, int, bool, float] | None:
    own = [r for (c, _), r in rows.items() if c == case and "failed" not in r]
    if not own:
        return None
    z = max(r["end_z"] for r in own)
    return sum(bool(r["found"]) for r in own), sum(bool(r["false"]) for r in own), z > 4.0, z


def _words(x: tuple[int, int, bool, float]) -> str:
    return f"{x[0]}, {x[1]}, {x[3]:.1f}"
