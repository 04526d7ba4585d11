"""Places in a module where one operator of the classic kinds makes a mutant, found in its syntax tree.

Comparisons are turned into their opposite, conditions negated, a `not` taken away, constants made 100 times as large (0
becomes 1). Left alone: annotations, defaults of type checkers, `__all__`, assertions, and texts of errors.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

#: Each comparison's opposite.
_OPPOSITE: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}
_FACTOR = 100


@dataclass(frozen=True, slots=True)
class Site:
    """One change of one text.

    Attributes:
        line, column: in the source, from 1.
        start, end: bytes of the source that are replaced.
        old, new: what stood there, what stands there now.
    """

    line: int
    column: int
    start: int
    end: int
    old: str
    new: str

    @property
    def title(self) -> str:
        """In one line."""
        return f"{' '.join(self.old.split())} → {' '.join(self.new.split())}"

    def applied(self, source: str) -> str:
        """The source with this change."""
        raw = source.encode()
        return (raw[: self.start] + self.new.encode() + raw[self.end :]).decode()


def sites(source: str) -> list[Site]:
    """All of them, in the order of the source."""
    lines = [0]
    for line in source.encode().splitlines(keepends=True):
        lines.append(lines[-1] + len(line))

    def at(node: ast.expr, new: str) -> Site:
        assert node.end_lineno is not None and node.end_col_offset is not None
        start, end = lines[node.lineno - 1] + node.col_offset, lines[node.end_lineno - 1] + node.end_col_offset
        return Site(node.lineno, node.col_offset + 1, start, end, source.encode()[start:end].decode(), new)

    found = [at(node, new) for node, new in _changes(ast.parse(source))]
    return sorted(found, key=lambda s: (s.start, s.end, s.new))


def _changes(node: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Expressions and what is to stand in their place."""
    for child in _visited(node):
        yield from _changes(child)
        if isinstance(child, ast.Compare) and len(child.ops) == 1:
            opposite = _OPPOSITE[type(child.ops[0])]()
            yield child, f"({ast.unparse(ast.Compare(child.left, [opposite], child.comparators))})"
        elif isinstance(child, ast.UnaryOp) and isinstance(child.op, ast.Not):
            yield child, f"({ast.unparse(child.operand)})"
        elif isinstance(child, ast.Constant) and type(child.value) in (int, float):
            yield child, repr(_FACTOR * child.value if child.value else type(child.value)(1))
        if isinstance(child, ast.If | ast.IfExp | ast.While) and not isinstance(child.test, ast.Compare | ast.UnaryOp):
            yield child.test, f"(not ({ast.unparse(child.test)}))"


def _visited(node: ast.AST) -> Iterator[ast.AST]:
    """Children that a test could notice a change of."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns", "decorator_list", "type_comment", "format_spec"}:
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.Assert | ast.Raise | ast.JoinedStr):
                yield child
