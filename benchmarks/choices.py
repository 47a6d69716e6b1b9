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
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from benchmarks.reporting import RESULTS, refuse
from data_pipeline.dataset.index import read_index
from data_pipeline.files import read_json, write_bytes, write_text
from eval.learned.comparison import BASELINES, ByObject, seeds_together
from mevs_jax.markdown import markdown_table

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


def keep(run: Path, folder: Path) -> None:
    """Stores the results of a run's walks for each object, and those of classes that are left out."""
    for path in (run / "learned").glob("seed_*/walks_novel.json"):
        write_bytes(folder / f"{path.parent.name}_novel.json", path.read_bytes())
    names = np.array(read_index(run / "data", "test", "name")["name"])
    for path in sorted((run / "learned").glob("seed_*/walks_*.npz")):
        if path.stem == "walks_novel":
            continue
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


def _differences(gains: dict[str, Any]) -> list[str]:
    """Cells of the differences at every number of views, bold where the interval leaves out zero."""
    cells = []
    for difference, (low, high) in zip(gains["difference"], gains["interval"], strict=True):
        cell = f"{100 * difference:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]".replace("-", "−")
        cells.append(f"**{cell}**" if low > 0 or high < 0 else cell)
    return cells


def _shown(values: list[str]) -> list[str]:
    return [values[step] if step < len(values) else "" for step in _SHOWN]


def _table(header: list[str], rows: list[list[str]]) -> str:
    return markdown_table(header, rows, " --- ") + "\n\n"


def tables(found: dict[str, Any]) -> str:
    """The tables of the result of `seeds_together`."""
    policies, steps, rows = found["policies"], [str(step + 1) for step in _SHOWN], []
    for name, policy in policies.items():
        accuracies = _shown([f"{100 * share:.1f}" for share in policy["after_views"]])
        closed = ["–" if share is None else f"{100 * share:.0f}" for share in found["gap_closed"].get(name, [])]
        error = f"{100 * max(policy['calibration_error']):.1f}"
        rows.append([policy["title"], *accuracies, ", ".join(closed).replace("-", "−"), error])
    text = _table(["next view chosen by", *steps, "% of the gap, 2–4", "ECE at most"], rows)
    for method in METHODS:
        rows = []
        for base in (*BASELINES, "learned"):
            if (gains := found["against"].get(base, {}).get(method)) is not None:
                title = policies[base]["title"]
                rows.append([title, *_shown(_differences(gains))[1:]])
                rows.append([f"{title}, nat/100", *_shown(_differences(gains["likelihood"]))[1:]])
        if rows:
            text += _table([f"{METHODS[method]} above", *steps[1:]], rows)
    return text


def novel_table(path: Path) -> str:
    """Gains over random views on classes that a policy was trained without; `path` is a stored `walks_novel.json`."""
    found = read_json(path)
    gains = {title: _differences(found["gain"][name]) for name, title in NOVEL.items() if name in found["gain"]}
    steps = [step for step in _SHOWN[1:] if step < len(next(iter(gains.values())))]
    rows = [[title, *(cells[step] for step in steps)] for title, cells in gains.items()]
    title = f"## Classes left out, {len(found['pairs'])} pairs, {found['objects']} objects: {path.stem}\n\n"
    return title + _table(["points above random", *(str(step + 1) for step in steps)], rows)


def main(run: Annotated[Path | None, tyro.conf.Positional] = None, to: str = "choices") -> None:
    """Keeps, and writes the tables.

    Args:
        run: directory in which `mevs study learned` was run.
        to: name of the folder of all results, and of the file with their tables.
    """
    folder = RESULTS / to
    if run is not None:
        keep(run, folder)
    kinds = defaultdict(list)
    for path in sorted(folder.glob("*.npz")):
        parts = re.fullmatch(r"seed_(\d+(?:_rotated)?)_(.*)", path.stem)
        if parts is None:
            refuse(f"the name of {path} has no seed and candidates; rename it like seed_0_lattice_40.npz")
        seed, kind = parts.groups()
        kinds[kind + "_rotated" * seed.endswith("rotated")].append((seed, *kept(path)))
    text = "Written by `benchmarks/choices.py`; accuracy in %, differences in points.\n\n"
    for kind, seeds in kinds.items():
        numbers, summaries, each = zip(*seeds, strict=True)
        views, objects = summaries[0]["views"], summaries[0]["objects"]
        text += f"## {kind}: {views} candidates, {objects} objects, seeds {', '.join(numbers)}\n\n"
        text += tables(seeds_together(summaries, each, "learned"))
        for number, one, own in seeds if len(seeds) > 1 else ():
            text += f"### seed {number}\n\n" + tables(seeds_together([one], [own], "learned"))
    text += "".join(map(novel_table, sorted(folder.glob("*_novel.json"))))
    write_text(RESULTS / f"{to}.md", text)
    print(text)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])
