"""L-systems on arrays: strings of modules, productions as lines of text, and rewriting of a whole string at once.

A production reads ``predecessor : condition -> successor @ weight``; condition and weight may be left out::

    G -> F[--G]F[-G][+G]
    A(s) : s > 0.1 -> F(s) [+(25) A(s*0.7)] @ 2
    A(s) : s > 0.1 -> F(s) [-(25) A(s*0.7)]

A symbol is one character, with up to four numbers in parentheses.  Conditions and numbers are arithmetic
(``+ - * / **``), comparisons, ``and``, ``or`` and ``not`` on the predecessor's parameters: nothing else is understood,
and nothing is executed.  Of the productions that fit a module one is drawn by weight; a module that none fits stays.

Reference: P. Prusinkiewicz, A. Lindenmayer (1990): The algorithmic beauty of plants, sections 1.7 and 1.10.
doi:10.1007/978-1-4613-8476-2.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

MOST = 5_000_000
"""Most modules of a string."""

WIDTH = 4
"""Most parameters of a module."""

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Expression = Callable[[Mapping[str, Floats]], Any]

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: np.logical_not,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
}


@dataclass(frozen=True)
class LString:
    """A string of modules: (n,) character codes and (n, 4) parameters, NaN where there is none."""

    codes: npt.NDArray[np.uint32]
    values: Floats

    def __len__(self) -> int:
        return len(self.codes)

    def __str__(self) -> str:
        text = self.codes.astype("<u4").tobytes().decode("utf-32-le")
        bare = np.asarray(np.isnan(self.values).all(axis=1))
        if bare.all():
            return text
        return "".join(
            symbol if plain else f"{symbol}({','.join(f'{value:g}' for value in row if value == value)})"
            for symbol, plain, row in zip(text, bare.tolist(), self.values.tolist(), strict=True)
        )

    def take(self, which: npt.NDArray[Any]) -> LString:
        """Return the modules with these numbers, or those where a mask is true."""
        return LString(self.codes[which], self.values[which])


@dataclass(frozen=True)
class Rule:
    """A production: what becomes of a symbol whose parameters have these names and meet the condition."""

    text: str
    symbol: int
    names: tuple[str, ...]
    condition: Expression | None
    codes: npt.NDArray[np.uint32]
    values: tuple[tuple[int, int, Expression], ...]
    weight: float


def parse_rules(lines: Sequence[str]) -> tuple[Rule, ...]:
    """Return the productions that the lines state.

    Raises:
        ValueError: a line is no production; the sentence says where and why.
    """
    return tuple(_parse_rule(line) for line in lines)


def parse_string(text: str, names: Sequence[str] = ()) -> tuple[LString, tuple[tuple[int, int, Expression], ...]]:
    """Return the modules of a text, and the expressions in it that depend on `names` by module and place.

    Raises:
        ValueError: brackets that do not match, or a parameter that is no arithmetic.
    """
    symbols: list[str] = []
    rows: list[list[float]] = []
    expressions: list[tuple[int, int, Expression]] = []
    text = "".join(text.split())
    place = depth = 0
    while place < len(text):
        symbol = text[place]
        place += 1
        depth += (symbol == "[") - (symbol == "]")
        if symbol in "(),:@" or depth < 0:
            raise ValueError(f"'{symbol}' at position {place} of '{text[:60]}' is out of place")
        row = [np.nan] * WIDTH
        if text.startswith("(", place):
            stop = _closing(text, place)
            parts = _split(text[place + 1 : stop])
            if len(parts) > WIDTH:
                raise ValueError(f"a module of '{text[:60]}' has {len(parts)} parameters; {WIDTH} at most fit")
            for column, part in enumerate(parts):
                expression, used = _expression(part)
                if not used <= set(names):
                    raise ValueError(f"'{part}' uses {', '.join(sorted(used - set(names)))}, which nothing defines")
                if used:
                    expressions.append((len(symbols), column, expression))
                else:
                    row[column] = float(expression({}))
            place = stop + 1
        symbols.append(symbol)
        rows.append(row)
    if depth:
        raise ValueError(f"'{text[:60]}' leaves {depth} '[' open; close each with ']'")
    codes = np.array([ord(symbol) for symbol in symbols], np.uint32)
    return LString(codes, np.array(rows, np.float64).reshape(-1, WIDTH)), tuple(expressions)


def rewrite(string: LString, rules: Sequence[Rule], rng: np.random.Generator) -> tuple[LString, Index]:
    """Apply the productions to all modules at once; also return the module that each new one comes from.

    Raises:
        ValueError: the string would grow beyond five million modules, or a parameter is not finite.
    """
    chosen = _choose(string, rules, rng)
    sizes = np.array([len(rule.codes) for rule in rules] + [1], np.int64)
    counts = sizes[chosen]
    total = int(counts.sum())
    if total > MOST:
        raise ValueError(f"the string grows to {total} symbols, over {MOST}; take fewer iterations or shorter rules")
    starts = np.cumsum(counts) - counts
    origin = np.repeat(np.arange(len(string)), counts)
    table = np.concatenate([*(rule.codes for rule in rules), np.zeros(1, np.uint32)])
    offsets = (np.cumsum(sizes) - sizes)[chosen[origin]] + np.arange(total) - starts[origin]
    kept = chosen[origin] == len(rules)
    codes = np.where(kept, string.codes[origin], table[offsets])
    values = np.where(kept[:, None], string.values[origin], np.nan)
    for number, rule in enumerate(rules):
        if not rule.values:
            continue
        places = np.flatnonzero(chosen == number)
        columns = {name: string.values[places, column] for column, name in enumerate(rule.names)}
        for module, column, expression in rule.values:
            with np.errstate(all="ignore"):
                found = np.broadcast_to(np.asarray(expression(columns), np.float64), places.shape)
            if not np.isfinite(found).all():
                raise ValueError(f"rule '{rule.text}' gives a parameter that is not finite; guard it with a condition")
            values[starts[places] + module, column] = found
    return LString(codes, values), origin


def _choose(string: LString, rules: Sequence[Rule], rng: np.random.Generator) -> Index:
    """Return the number of the production for each module; `len(rules)` where none fits."""
    dice = rng.random(len(string))
    chosen = np.full(len(string), len(rules), np.int64)
    given = np.count_nonzero(~np.isnan(string.values), axis=1)
    for symbol in dict.fromkeys(rule.symbol for rule in rules):
        places = np.flatnonzero(string.codes == symbol)
        if not len(places):
            continue
        numbers = [number for number, rule in enumerate(rules) if rule.symbol == symbol]
        weights = np.zeros((len(numbers), len(places)))
        for row, number in enumerate(numbers):
            rule = rules[number]
            fits = given[places] == len(rule.names)
            if rule.condition is not None:
                columns = {name: string.values[places, column] for column, name in enumerate(rule.names)}
                with np.errstate(all="ignore"):
                    fits = fits & np.asarray(rule.condition(columns), np.bool_)
            weights[row] = rule.weight * fits
        reach = np.cumsum(weights, axis=0)
        picked = np.minimum((dice[places] * reach[-1] >= reach).sum(axis=0), len(numbers) - 1)
        chosen[places] = np.where(reach[-1] > 0, np.array(numbers)[picked], len(rules))
    return chosen


def _parse_rule(line: str) -> Rule:
    left, arrow, right = line.partition("->")
    if not arrow:
        raise ValueError(f"rule '{line}' has no '->'; write it as 'F -> F[+G]F'")
    head, _, condition = left.partition(":")
    successor, _, weight = right.partition("@")
    head = "".join(head.split())
    names = tuple(_split(head[2:-1])) if len(head) > 1 else ()
    if not head or head[0] in "[](),:@" or (len(head) > 1 and (head[1] != "(" or head[-1] != ")")):
        raise ValueError(f"rule '{line}' must start with one symbol, such as F or F(s)")
    if not all(name.isidentifier() for name in names) or len(set(names)) < len(names) or len(names) > WIDTH:
        raise ValueError(f"rule '{line}' must name its parameters apart, {WIDTH} at most, as in F(s, w)")
    try:
        share = float(weight) if weight.strip() else 1.0
    except ValueError:
        share = -1.0
    if not 0 < share < np.inf:
        raise ValueError(f"rule '{line}' has the weight '{weight.strip()}'; give a number above 0")
    try:
        test, used = _expression(condition) if condition.strip() else (None, set())
        if not used <= set(names):
            raise ValueError(f"its condition uses {', '.join(sorted(used - set(names)))}, which nothing defines")
        modules, expressions = parse_string(successor, names)
    except ValueError as error:
        raise ValueError(f"rule '{line}': {error}") from error
    constants = tuple(
        (int(module), int(column), _constant(float(modules.values[module, column])))
        for module, column in np.argwhere(~np.isnan(modules.values))
    )
    return Rule(line, ord(head[0]), names, test, modules.codes, (*constants, *expressions), share)


def _closing(text: str, start: int) -> int:
    depth = 0
    for place in range(start, len(text)):
        depth += (text[place] == "(") - (text[place] == ")")
        if not depth:
            return place
    raise ValueError(f"'{text[:60]}' leaves a '(' open; close it with ')'")


def _split(text: str) -> list[str]:
    """Split at the commas outside of parentheses."""
    parts, depth = [""], 0
    for symbol in text:
        depth += (symbol == "(") - (symbol == ")")
        if symbol == "," and not depth:
            parts.append("")
        else:
            parts[-1] += symbol
    return parts


def _constant(value: float) -> Expression:
    return lambda _: value


def _expression(text: str) -> tuple[Expression, set[str]]:
    """Return an arithmetic expression as a function of arrays by name, and the names that it uses."""
    try:
        tree = ast.parse(text.strip()[:1000], mode="eval").body
        used = {part.id for part in ast.walk(tree) if isinstance(part, ast.Name)}
        return _compiled(tree), used
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ValueError(f"'{text.strip()[:60]}' is no arithmetic of numbers and parameters") from error


def _compiled(tree: ast.expr) -> Expression:
    match tree:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return _constant(float(value))
        case ast.Name(id=name):
            return lambda columns: columns[name]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            inner, apply = _compiled(operand), _OPERATORS[type(op)]
            return lambda columns: apply(inner(columns))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            first, second, combine = _compiled(left), _compiled(right), _OPERATORS[type(op)]
            return lambda columns: combine(first(columns), second(columns))
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _OPERATORS:
            first, second, compare = _compiled(left), _compiled(right), _OPERATORS[type(op)]
            return lambda columns: compare(first(columns), second(columns))
        case ast.BoolOp(op=op, values=values):
            parts, join = [_compiled(value) for value in values], _OPERATORS[type(op)]
            return lambda columns: reduce(join, [part(columns) for part in parts])
    raise ValueError(type(tree).__name__)
