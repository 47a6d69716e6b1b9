"""Results of every policy on each test object: `python benchmarks/choices.py [RUN]`.

RUN is a directory in which `mevs study learned` was run. Its walks are added to those in
`benchmarks/results/choices/`, in a file for each seed and kind of candidates. `benchmarks/results/choices.md` has the
tables of all files there: means over seeds, first for each object, with 95 % intervals over objects. So seeds can be
trained on different machines. With `--to NAME` the folder and the tables are called NAME. `seed_K_novel.json` has the
results on classes that policies were trained without, as the study stored them.

With these files another policy can be compared object by object. A file has the `names` of the objects in order, and
for each policy `right`, the shares of its walks that are right after 1, 2, … views, in 240ths if in bytes and
otherwise in 720ths (exact for 8, 9, 10, 40 or 60 start views, with one or two walks from each); `from_some`, the same
for the start views of the oracles; and `likelihood`, the mean log-probability of the true class, in half precision.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import tyro

from data_pipeline.dataset.builder import open_split
from data_pipeline.files import read_json, write_bytes, write_text
from eval.learned.comparison import BASELINES, ByObject, seeds_together
from mevs_jax.markdown import markdown_table

RESULTS = Path(__file__).parent / "results"
METHODS = {
    "learned": "view policy",
    "expected_views": "information gain by expected views",
    "learned_and_table": "view policy and expected views",
}
NOVEL = {
    "trained_without": "view policy, trained without the two classes",
    "trained_with": "view policy, trained with all classes",
    "expected_views": "expected views",
    "expected_views_without": "expected views without those of the two classes",
}
_WHOLES: dict[type[np.unsignedinteger], int] = {np.uint8: 240, np.uint16: 720}
"""The stored value of a share of 1."""
_KEPT = ("objects", "views", "trying_starts", "single_view")
_KEPT_OF_EACH = ("title", "knows", "calibration_error")
_SHOWN = (0, 1, 2, 3, 5, 7)
"""Steps of a walk that the tables show; 0 is the first view."""


@dataclass(frozen=True)
class Options:
    run: Annotated[Path | None, tyro.conf.Positional] = None
    """directory in which `mevs study learned` was run"""
    to: str = "choices"
    """name of the folder of all results, and of the file with their tables"""


def keep(run: Path, folder: Path) -> None:
    """Stores the results of a run's walks for each object, and those of classes that are left out."""
    for path in (run / "learned").glob("seed_*/walks_novel.json"):
        write_bytes(folder / f"{path.parent.name}_novel.json", path.read_bytes())
    names = np.array([one["name"].decode() for one in open_split(run / "data", "test", ("name",))])
    for path in sorted((run / "learned").glob("seed_*/walks_*.npz")):
        found = read_json(path.with_suffix(".json"))
        summary: dict[str, Any] = {key: found[key] for key in _KEPT}
        summary["policies"] = {
            name: {key: policy[key] for key in _KEPT_OF_EACH} for name, policy in found["policies"].items()
        }
        with np.load(path) as walks:
            arrays: dict[str, Any] = {key: _packed(key, walks[key]) for key in walks.files}
        kind = path.stem.removeprefix("walks_")
        buffer = io.BytesIO()
        np.savez_compressed(buffer, summary=json.dumps(summary), names=names, **arrays)
        write_bytes(folder / f"{path.parent.name}_{kind}.npz", buffer.getvalue())


def _packed(key: str, values: np.ndarray) -> np.ndarray:
    if key.endswith(" likelihood"):
        return values.astype(np.float16)
    for kind, whole in _WHOLES.items():
        counts = np.round(values * whole)
        if np.abs(counts - values * whole).max() <= 1e-2:
            return counts.astype(kind)
    raise ValueError(f"{key}: the shares are no multiples of 1/240 or 1/720; change the number of walks")


def _shares(counts: np.ndarray) -> np.ndarray:
    return counts / _WHOLES[counts.dtype.type]


def kept(path: Path) -> tuple[dict[str, Any], dict[str, ByObject]]:
    """The stored metrics of one seed, and the results of each policy by object."""
    with np.load(path) as arrays:
        summary = json.loads(str(arrays["summary"]))
        each = {
            name: ByObject(
                right=_shares(arrays[f"{name} right"]),
                likelihood=arrays[f"{name} likelihood"].astype(np.float32),
                from_some=_shares(arrays[f"{name} from_some"]),
            )
            for name in summary["policies"]
        }
    return summary, each


def _difference(difference: float, interval: list[float]) -> str:
    low, high = interval
    cell = f"{100 * difference:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]".replace("-", "−")
    return f"**{cell}**" if low > 0 or high < 0 else cell


def _table(header: list[str], rows: list[list[str]]) -> str:
    return markdown_table(header, rows, " --- ") + "\n\n"


def tables(found: dict[str, Any]) -> str:
    """The tables of the result of `seeds_together`."""
    policies, steps = found["policies"], [str(step + 1) for step in _SHOWN]

    def shown(values: list[str]) -> list[str]:
        return [values[step] if step < len(values) else "" for step in _SHOWN]

    rows = []
    for name, policy in policies.items():
        closed = found["gap_closed"].get(name, [])
        rows.append(
            [
                policy["title"],
                *shown([f"{100 * share:.1f}" for share in policy["after_views"]]),
                ", ".join("–" if share is None else f"{100 * share:.0f}" for share in closed).replace("-", "−"),
                f"{100 * max(policy['calibration_error']):.1f}",
            ]
        )
    text = _table(["next view chosen by", *steps, "% of the gap, 2–4", "ECE at most"], rows)
    for method in METHODS:
        rows = []
        for base in (*BASELINES, "learned"):
            gains = found["against"].get(base, {}).get(method)
            if gains is not None:
                for of, unit in ((gains, ""), (gains["likelihood"], ", nat/100")):
                    known = [_difference(*cell) for cell in zip(of["difference"], of["interval"], strict=True)]
                    rows.append([policies[base]["title"] + unit, *shown(known)[1:]])
        if rows:
            text += _table([f"{METHODS[method]} above", *steps[1:]], rows)
    return text


def novel_table(path: Path) -> str:
    """Gains over random views on classes that a policy was trained without; `path` is a stored `walks_novel.json`."""
    found = read_json(path)
    steps = [step for step in _SHOWN[1:] if step < len(next(iter(found["gain"].values()))["difference"])]
    rows = [
        [title, *(_difference(gain["difference"][step], gain["interval"][step]) for step in steps)]
        for name, title in NOVEL.items()
        if (gain := found["gain"].get(name)) is not None
    ]
    title = f"## Classes left out, {len(found['pairs'])} pairs, {found['objects']} objects: {path.stem}\n\n"
    return title + _table(["points above random", *(str(step + 1) for step in steps)], rows)


def main(options: Options) -> None:
    folder = RESULTS / options.to
    if options.run is not None:
        keep(options.run, folder)
    kinds = defaultdict(list)
    for path in sorted(folder.glob("*.npz")):
        parts = re.fullmatch(r"seed_(\d+(?:_rotated)?)_(.*)", path.stem)
        if parts is None:
            print(
                f"the name of {path} has no seed and candidates; rename it like seed_0_lattice_40.npz", file=sys.stderr
            )
            sys.exit(2)
        seed, kind = parts.groups()
        kinds[kind + "_rotated" * seed.endswith("rotated")].append((seed, *kept(path)))
    text = "Written by `benchmarks/choices.py`; accuracy in %, differences in points.\n\n"
    for kind, seeds in kinds.items():
        numbers, found, each = zip(*seeds, strict=True)
        text += (
            f"## {kind}: {found[0]['views']} candidates, {found[0]['objects']} objects, seeds {', '.join(numbers)}\n\n"
        )
        text += tables(seeds_together(found, each, "learned"))
        if len(seeds) > 1:
            for number, one, own in seeds:
                text += f"### seed {number}\n\n" + tables(seeds_together([one], [own], "learned"))
    text += "".join(map(novel_table, sorted(folder.glob("*_novel.json"))))
    write_text(folder.with_name(f"{folder.name}.md"), text)
    print(text)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__.splitlines()[0]))
