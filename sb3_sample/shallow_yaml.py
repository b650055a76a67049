"""YAML of files that anybody may have written: nesting is limited, since reading recurses and is quadratic in it."""

from typing import Any

import yaml

#: Levels of nesting in a file.
MAX_DEPTH = 50


class ShallowLoader(yaml.SafeLoader):
    """Make plain values of YAML nested at most ``MAX_DEPTH`` deep; deeper nesting is a ``MarkedYAMLError``."""

    def fetch_flow_collection_start(self, token: Any) -> None:
        self._limit(self.flow_level)
        super().fetch_flow_collection_start(token)

    def add_indent(self, column: int) -> bool:
        self._limit(len(self.indents))
        return bool(super().add_indent(column))

    def _limit(self, depth: int) -> None:
        if depth >= MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"it nests deeper than {MAX_DEPTH}", problem_mark=self.get_mark())
