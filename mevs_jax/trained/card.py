"""The model card of a trained system, in the form that the Hugging Face hub shows."""

from __future__ import annotations

from mevs_jax.markdown import markdown_table
from mevs_jax.trained.description import Description

_INPUTS = {
    "depth": "depth as (far − depth) / (far − near), background 0, where near and far bound the object's sphere",
    "depth_and_normals": "depth as (far − depth) / (far − near), and the unit normal in the camera's frame; background 0",
    "image": "grey levels in [0, 1], background 0",
}


def model_card(description: Description, size: int) -> str:
    """Returns the card as Markdown.

    Args:
        description: of the system.
        size: of its weights, in bytes.
    """
    camera, data = description.camera, description.data
    objects = ", ".join(f"{count} {split}" for split, count in data.objects.items())
    channels = f"{description.image.channels} channel{'s' * (description.image.channels > 1)}"
    lines = [
        "---",
        "library_name: mevs_jax",
        "tags: [active-recognition, next-best-view, depth, jax]",
        "---",
        "",
        f"# Recognition of {len(description.classes)} classes by chosen views",
        "",
        "```python",
        "import mevs_jax",
        "",
        'system = mevs_jax.load("PATH OF THIS FOLDER")',
        "agent = system.agent()",
        "```",
        "",
        f"* Classes: {', '.join(description.classes)}.",
        f"* Data: {data.source} ({objects} objects; fingerprint {data.fingerprint}).",
        f"* Camera: {camera.resolution}×{camera.resolution} pixels, field of view {camera.field_of_view:g}°, "
        f"{camera.distance:g} radii from the object's centre, z up in the image.",
        f"* Image: {_INPUTS[description.image.content]}; {channels}.",
        *_size(description),
        f"* Kind: {_kind(description)}.",
        f"* Policy by default: `{description.best}` ({description.chosen_by}); with unknown yaw `{description.best_unposed}`.",
        f"* Weights: {size / 1e6:.1f} MB. Made with "
        + ", ".join(f"{name} {version}" for name, version in description.made_with.items())
        + ".",
        "",
        *_figures(description),
        "## Limits",
        "",
        "* Only these classes are known. Detection of objects of other classes was not measured for this system.",
        "* The figures are of perfect depth. Noise, missing depth and wrong centres cost accuracy.",
        "* Confidence is calibrated on validation objects of the same source.",
        "",
    ]
    return "\n".join(lines)


def _size(description: Description) -> list[str]:
    size = description.size
    if size is None:
        return []
    return [f"* Size: the object's radius, where it is told, from {size.smallest:g} to {size.largest:g} m."]


def _kind(description: Description) -> str:
    if description.kind == "recogniser":
        return "a network fuses the features of all views (recogniser)"
    return "the logits of all views are added, with a temperature for each number of views (classifier)"


def _figures(description: Description) -> list[str]:
    after = description.evaluation.get("after_views")
    if not isinstance(after, dict) or not after:
        return []
    most = max(map(len, after.values()))
    head = ["", *(f"{count} view{'s' * (count > 1)}" for count in range(1, most + 1))]
    rows = [["`" + name + "`", *(f"{100 * share:.1f}" for share in shares)] for name, shares in after.items()]
    about = (
        f"Share of {description.evaluation.get('objects', 'the')} test objects recognised, in %, from all first views:"
    )
    return ["## Evaluation", "", about, "", markdown_table(head, rows), ""]
