"""YAML of files that anybody may have written: limited nesting, in which reading is quadratic and recurses."""

from typing import Any

import yaml

#: Levels of nesting in a file.
MAX_DEPTH = 50


class ShallowLoader(yaml.SafeLoader):
    """Makes plain values of YAML that nests at most ``MAX_DEPTH`` deep; a deeper one is a ``MarkedYAMLError``."""

    def fetch_flow_collection_start(self, token: Any) -> None:
        self._limit(self.flow_level)
        super().fetch_flow_collection_start(token)

    def add_indent(self, column: int) -> bool:
        self._limit(len(self.indents))
        return bool(super().add_indent(column))

    def _limit(self, depth: int) -> None:
        if depth >= MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"it nests deeper than {MAX_DEPTH}", problem_mark=self.get_mark())
