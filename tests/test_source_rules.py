"""The rules that every source file keeps: docstrings of kernels, first lines, length, names."""

import ast
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import barsight

ROOT = Path(barsight.__file__).parent
HOME = Path(__file__).parents[1]
TREES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(ROOT.rglob("*.py"))
}
PROGRAMS = {
    str(path.relative_to(HOME)): ast.parse(path.read_text(encoding="utf-8"))
    for folder in ("benchmarks", "fuzz", "tools")
    for path in sorted((HOME / folder).rglob("*.py"))
}
"""Beside the package: they keep the rules of first lines, length and names."""
QUESTIONS = ("What", "Where", "By", "How", "Whether", "Why", "When", "Which", "Who", "Of")
TESTS = {
    path.name: ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(Path(__file__).parent.glob("*.py"))
}
MAX_LINES = 60
MAX_PARAMETERS = 10
MIN_TWIN = 18
"""Nodes of syntax from which on a body may stand only once."""
ARRAYS = re.compile(r"\b(?:U?Int\d+|Float\d+|Bool|NDArray)\b")
EXTENT = r"[^(),]*\b(?:[A-Z_]+|[1-9]\d*|[a-z]+s)\b[^(),]*"
SHAPE = re.compile(rf"\((?:{EXTENT},\s*)+(?:{EXTENT})?\)")
"""(H, W), (N, 3), (6,), (rows, columns), (K + 1, 2 reach + 1): numbers, capitals and plurals. Not (x, y)."""
REPEATED: set[str] = set()
"""Class names that still occur more than once. Rename, then take it off; nothing is added."""

EXTREME = re.compile(r"_?(?:least|most)(?:_\w+)?|\w+_(?:least|most)(?:_\w+)?", re.IGNORECASE)
"""Names that say `least` or `most` where the package says `min` or `max`."""

Function = ast.FunctionDef | ast.AsyncFunctionDef
Documented = ast.Module | ast.ClassDef | Function


def documented(tree: ast.AST) -> list[Documented]:
    return [node for node in ast.walk(tree) if isinstance(node, Documented)]


def functions(tree: ast.AST) -> list[Function]:
    return [node for node in ast.walk(tree) if isinstance(node, Function)]


def is_kernel(function: Function) -> bool:
    calls = [d.func for d in function.decorator_list if isinstance(d, ast.Call)]
    return any(isinstance(call, ast.Name) and call.id == "kernel" for call in calls)


def undocumented_kernels(tree: ast.AST) -> set[str]:
    return {f.name for f in functions(tree) if is_kernel(f) and not ast.get_docstring(f)}


def arrays_of(node: ast.AST) -> str:
    """The types of a kernel's parameters and result, or of a named tuple's members."""
    if isinstance(node, Function) and is_kernel(node):
        return f"{ast.unparse(node.args)} -> {ast.unparse(node.returns) if node.returns else None}"
    if isinstance(node, ast.ClassDef) and "NamedTuple" in map(ast.unparse, node.bases):
        return " ".join(ast.unparse(n.annotation) for n in node.body if isinstance(n, ast.AnnAssign))
    return ""


def without_shapes(tree: ast.AST) -> set[str]:
    """Kernels of arrays, and the named tuples that hand arrays to them, whose docstrings name no shape."""
    return {
        node.name
        for node in documented(tree)
        if not isinstance(node, ast.Module)
        and ARRAYS.search(arrays_of(node))
        and not SHAPE.search(ast.get_docstring(node) or "")
    }


def questions(tree: ast.AST) -> list[str]:
    first_lines = [(ast.get_docstring(node) or "\n").splitlines()[0] for node in documented(tree)]
    return [line for line in first_lines if line.split(" ")[0] in QUESTIONS]


def lines(function: Function) -> int:
    """From `def` to the end, docstring and all."""
    return (function.end_lineno or 0) - function.lineno + 1


def long_functions(tree: ast.AST) -> set[str]:
    return {f.name for f in functions(tree) if lines(f) > MAX_LINES}


def extremes(tree: ast.AST) -> set[str]:
    """Names of functions, parameters, fields, attributes and constants; not of plain local variables."""
    named = {node.name for node in documented(tree) if not isinstance(node, ast.Module)}
    for f in functions(tree):
        named |= {one.arg for one in (*f.args.posonlyargs, *f.args.args, *f.args.kwonlyargs)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            named.add(node.attr)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            # A plain word is a local variable's; a field's or constant's is not.
            named |= {node.id} - {"least", "most"}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            named.add(node.target.id)
    return {name for name in named if EXTREME.fullmatch(name)}


def wide_kernels(tree: ast.AST) -> set[str]:
    return {
        f.name
        for f in functions(tree)
        if is_kernel(f) and len(f.args.posonlyargs + f.args.args + f.args.kwonlyargs) > MAX_PARAMETERS
    }


def wide_functions(tree: ast.AST) -> set[str]:
    """Functions of more parameters than a kernel may have; `self` and `cls` aside."""
    found = set()
    for f in functions(tree):
        own = [a.arg for a in (*f.args.posonlyargs, *f.args.args, *f.args.kwonlyargs)]
        if len(own) - (own[:1] in (["self"], ["cls"])) > MAX_PARAMETERS:
            found.add(f.name)
    return found


def names_used(trees: Iterable[ast.AST]) -> set[str]:
    """All that is imported, as `package.module.name`: by its name, or with its module and used from there."""
    used = set()
    for tree in trees:
        lines = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        imported = {
            alias.asname or alias.name: f"{n.module}.{alias.name}" for n in lines for alias in n.names
        }
        used |= {*imported.values(), *(str(node.module) for node in lines)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                used.add(f"{imported.get(node.value.id)}.{node.attr}")
    return used


def repeated_classes(trees: Iterable[ast.AST]) -> set[str]:
    names = Counter(n.name for tree in trees for n in documented(tree) if isinstance(n, ast.ClassDef))
    return {name for name, times in names.items() if times > 1}


def twins(trees: Mapping[str, ast.AST]) -> list[set[str]]:
    """Functions with the same body, docstring aside; short ones, as properties are, may be."""
    places: dict[str, set[str]] = {}
    for module, tree in trees.items():
        for f in functions(tree):
            body = [ast.dump(node) for node in f.body[ast.get_docstring(f) is not None :]]
            if sum(part.count("(") for part in body) >= MIN_TWIN:
                places.setdefault("".join(body), set()).add(f"{module}.{f.name}")
    return [names for names in places.values() if len(names) > 1]


def test_no_function_stands_twice() -> None:
    assert twins(TREES | PROGRAMS) == []


def test_every_kernel_has_a_docstring() -> None:
    assert sum(is_kernel(f) for tree in TREES.values() for f in functions(tree)) > 200
    assert {m: names for m, tree in TREES.items() if (names := undocumented_kernels(tree))} == {}


def test_kernels_of_arrays_tell_their_shapes() -> None:
    assert {m: names for m, tree in TREES.items() if (names := without_shapes(tree))} == {}


def test_no_first_line_is_a_question() -> None:
    everything = TREES | PROGRAMS | TESTS
    assert {m: lines for m, tree in everything.items() if (lines := questions(tree))} == {}


def test_functions_are_short() -> None:
    assert {m: names for m, tree in (TREES | PROGRAMS).items() if (names := long_functions(tree))} == {}


def test_bounds_are_called_min_and_max() -> None:
    found = {m: names for m, tree in (TREES | PROGRAMS).items() if (names := extremes(tree))}
    assert found == {}


def test_kernels_have_few_parameters() -> None:
    assert {m: names for m, tree in TREES.items() if (names := wide_kernels(tree))} == {}


def test_functions_have_few_parameters() -> None:
    found = {m: names for m, tree in (TREES | PROGRAMS).items() if (names := wide_functions(tree))}
    # Numba hands an intrinsic its values one by one.
    assert found == {"stereo.direct.semiglobal.paths": {"_extend_paths"}}


def test_every_kernel_is_tested() -> None:
    """Public ones by name: one that is only reached through others may be wrong in what they don't ask of it.
    Of private ones the module.
    """
    kernels = [
        (f"barsight.{m}", f.name) for m, tree in TREES.items() for f in functions(tree) if is_kernel(f)
    ]
    tested = names_used(TESTS.values())
    wanted = {module if name.startswith("_") else f"{module}.{name}" for module, name in kernels}
    assert wanted - tested == set()


def test_class_names_occur_once() -> None:
    assert repeated_classes(TREES.values()) == REPEATED


def test_what_breaks_a_rule_is_found() -> None:
    body = "    x = 1\n" * (MAX_LINES - 1)
    kernel = ast.parse(f'@kernel()\ndef bare():\n{body}    """no docstring"""\n')
    assert undocumented_kernels(kernel) == {"bare"} == long_functions(kernel)
    sound = ast.parse(f'@kernel()\ndef told():\n    """Whiten rows."""\n{body[:-10]}')
    assert undocumented_kernels(sound) == set() == long_functions(sound)
    slow = ast.parse(f'async def served():\n    """Where it goes."""\n{body}    x = 2\n')
    assert long_functions(slow) == {"served"} and questions(slow) == ["Where it goes."]
    worded = (
        "MOST = 1\nclass A:\n    least_m: float\ndef f(most, *, least):\n    self._least, most = least, 2"
    )
    assert extremes(ast.parse(worded)) == {"MOST", "least_m", "most", "least", "_least"}
    assert extremes(ast.parse("def f(utmost, min_m):\n    most = least_squares(at_most.x)")) == set()
    names = ", ".join(f"x{i}" for i in range(MAX_PARAMETERS))
    wide = ast.parse(f"@kernel()\ndef even({names}):\n    pass\n@kernel()\ndef more({names}, y):\n    pass\n")
    assert wide_kernels(wide) == {"more"} == wide_functions(wide)
    method = ast.parse(
        f"class A:\n    async def even(self, {names}): ...\n    def more(self, {names}, *, y): ..."
    )
    assert wide_functions(method) == {"more"}
    assert questions(ast.parse('"""How it works."""\nclass A:\n    """Howitzer."""')) == ["How it works."]
    once = "def {}(a, b):\n    {}return [x * a + b for x in range(a) if x > b and x != 7]"
    same = {"m": ast.parse(once.format("f", "")), "n": ast.parse(once.format("g", "'told'\n    "))}
    assert twins(same) == [{"m.f", "n.g"}] and twins({"m": same["m"]}) == []
    assert repeated_classes([ast.parse("class A: ...\nclass B: ..."), ast.parse("class A: ...")]) == {"A"}


def test_shapes_are_told_from_coordinates() -> None:
    taking = '@kernel()\ndef k(a: {}) -> {}:\n    """Do it. a: {}."""\n'
    for told in ("(H, W)", "(N,)", "(6, 6)", "(rows, columns)", "(2 half + 1, N - 1)", "(K, 3), of which"):
        assert without_shapes(ast.parse(taking.format("Float32", "int", told))) == set()
    for untold in ("(x, y)", "(x, y, 1)", "(N)", "(0, 0)", "a row"):
        assert without_shapes(ast.parse(taking.format("tuple[UInt8, int]", "None", untold))) == {"k"}
    assert without_shapes(ast.parse(taking.format("float", "Float64", "m"))) == {"k"}
    assert without_shapes(ast.parse(taking.format("np.float32", "float", "m"))) == set()
    assert without_shapes(ast.parse("class C(NamedTuple):\n    a: Bool\nclass D:\n    a: Bool")) == {"C"}


def test_names_are_used_by_import_or_from_their_module() -> None:
    tree = ast.parse("def f():\n    from a.b import c, d as e\n    c.g(e.h)\n    x.y()\nimport i")
    assert names_used([tree]) == {"a.b", "a.b.c", "a.b.d", "a.b.c.g", "a.b.d.h", "None.y"}
