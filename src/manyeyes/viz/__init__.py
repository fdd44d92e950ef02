# SPDX-License-Identifier: Apache-2.0
"""Pictures, tables and reports of what agents saw."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.viz.animation import save_animation as save_animation
    from manyeyes.viz.birds_eye import (
        BirdsEyeScene as BirdsEyeScene,
        draw_scene as draw_scene,
        make_scene as make_scene,
        save_png as save_png,
    )
    from manyeyes.viz.map_figures import MapPanel as MapPanel, save_figure as save_figure
    from manyeyes.viz.map_page import (
        Basemap as Basemap,
        MapPage as MapPage,
        ObservedElements as ObservedElements,
        make_page as make_page,
        save_map_page as save_map_page,
    )
    from manyeyes.viz.report import Chapter as Chapter, HtmlReport as HtmlReport, save_report as save_report

__getattr__, __dir__ = attach(__name__)
