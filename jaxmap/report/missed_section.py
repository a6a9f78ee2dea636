"""The ensemble of a run as a section of its report."""

from __future__ import annotations

from html import escape

from jaxmap.errors import JaxmapError
from jaxmap.report.inline import inline_image
from jaxmap.report.run_contents import RunContents
from jaxmap.report.tables import group
from jaxmap.report.wording import value_text


def missed_section(folder: RunContents, remarks: list[str]) -> str:
    """Where the map may have missed its class: the picture and what is expected; empty without an ensemble.

    A picture that cannot be read is left out and told in `remarks`.
    """
    path, ensemble = folder.path / "missed.png", group(folder.metrics, "ensemble")
    if not path.is_file() or not ensemble:
        return ""
    target = escape(str(ensemble.get("class")))
    try:
        image = inline_image(path, f"How likely it is that the map missed {target}, from above")
    except JaxmapError:
        remarks.append(f"{path.name} could not be read and is left out.")
        return ""
    told = (
        f"How likely a place that the map does not call {target} is {target} all the same, by an ensemble of "
        f"{value_text(ensemble.get('members'))} maps, each with errors of its own in poses, disparities and the "
        f"sensor model. Over all {value_text(ensemble.get('observed_area_m2'), 'm²')} observed, "
        f"{value_text(ensemble.get('missed_area_expected_m2'), 'm²')} of {target} are expected to be missed, beside "
        f"{value_text(ensemble.get('called_area_m2'), 'm²')} called so."
    )
    return f'<section><h2>What may be missed</h2><p>{told}</p><div class="paper">{image}</div></section>'
