"""The tables of a report's page, as they are read."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import NamedTuple


class Table(NamedTuple):
    """Headings and rows; the first cell of a row is its name."""

    headings: list[str]
    rows: list[list[str]]

    def row(self, name: str) -> list[str]:
        """What stands beside a name; there must be one cell under each heading."""
        (found,) = [row for row in self.rows if row[0] == name]
        assert len(found) == len(self.headings), (self.headings, found)
        return found[1:]


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[list[str]]] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self.rows.append([])
        elif tag == "tr":
            self.rows[-1].append([])
        elif tag in ("th", "td"):
            self.rows[-1][-1].append("")
            self._inside = True

    def handle_endtag(self, tag: str) -> None:
        self._inside = self._inside and tag not in ("th", "td")

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.rows[-1][-1][-1] += data


def tables_of(page: str) -> list[Table]:
    """All tables of a page, in their order."""
    reader = _Reader()
    reader.feed(page)
    return [Table(rows[0], rows[1:]) for rows in reader.rows]
