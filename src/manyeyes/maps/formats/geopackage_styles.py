# SPDX-License-Identifier: Apache-2.0
"""Styles inside a GeoPackage: the table ``layer_styles``, out of which QGIS loads the default style of a layer (QML).

The name and the columns of the table are those by which QGIS (3.22) finds a style; it skips a table without one of them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from xml.sax.saxutils import quoteattr

TABLE = "layer_styles"
COLOURS = {
    "divider": "224,123,0,255",
    "boundary": "46,125,50,255",
    "crossing": "21,101,192,110",
    "stop_line": "142,36,170,255",
}
"""Red, green, blue and opacity of each kind, those of the web page."""
_WIDTH_MM = {"divider": 0.5, "boundary": 0.8, "stop_line": 1.0}
_LAYER_KINDS = {"lines": ("divider", "boundary", "stop_line"), "crossings": ("crossing",)}
_CREATE = f"""CREATE TABLE {TABLE} (id INTEGER PRIMARY KEY AUTOINCREMENT, f_table_catalog TEXT(256), f_table_schema TEXT(256),
f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN,
description TEXT, owner TEXT(30), ui TEXT(30), update_time DATETIME DEFAULT CURRENT_TIMESTAMP)"""


def write_styles(path: Path, layers: Sequence[str], date: str) -> None:
    """Add default styles of layers (``lines``, ``crossings``) to a GeoPackage; date: of the entries, ISO 8601."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(_CREATE)
        contents = (
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, last_change) VALUES (?, 'attributes', ?, ?)"
        )
        connection.execute(contents, (TABLE, TABLE, date))
        for layer in layers:
            row = ("", "", layer, "geom", "kind", make_qml(layer), "", 1, "colour by kind", "manyeyes", "", date)
            connection.execute(f"INSERT INTO {TABLE} VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)


def make_qml(layer: str) -> str:
    """Return the QML of a layer: one symbol a kind."""
    kinds = _LAYER_KINDS[layer]
    categories = "".join(
        f'<category value={quoteattr(kind)} label={quoteattr(kind.replace("_", " "))} symbol="{k}" render="true"/>'
        for k, kind in enumerate(kinds)
    )
    symbols = "".join(_symbol(kind, k) for k, kind in enumerate(kinds))
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis styleCategories="Symbology" version="3.22">'
        '<renderer-v2 type="categorizedSymbol" attr="kind" enableorderby="0" forceraster="0" symbollevels="0">'
        f"<categories>{categories}</categories><symbols>{symbols}</symbols></renderer-v2></qgis>\n"
    )


def _symbol(kind: str, number: int) -> str:
    if kind == "crossing":
        layer = {"color": COLOURS[kind], "outline_color": COLOURS[kind], "outline_width": "0.3", "style": "solid"}
        name, symbol_type = "SimpleFill", "fill"
    else:
        layer = {"line_color": COLOURS[kind], "line_width": str(_WIDTH_MM[kind]), "line_style": "solid"}
        name, symbol_type = "SimpleLine", "line"
    options = "".join(f'<Option type="QString" name={quoteattr(k)} value={quoteattr(v)}/>' for k, v in layer.items())
    return (
        f'<symbol type="{symbol_type}" name="{number}" alpha="1"><layer class="{name}" enabled="1" pass="0" locked="0">'
        f'<Option type="Map">{options}</Option></layer></symbol>'
    )
