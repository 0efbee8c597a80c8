"""The rules that every source file keeps: docstrings of kernels, first lines, length, names."""

import ast
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import barsight

ROOT = Path(barsight.__file__).parent
TREES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(ROOT.rglob("*.py"))
}
QUESTIONS = ("What", "Where", "By", "How", "Whether", "Why", "When", "Which", "Who", "Of")
TESTS = [ast.parse(path.read_text(encoding="utf-8")) for path in sorted(Path(__file__).parent.glob("*.py"))]
MAX_LINES = 60
LONG = {"report.calibration.camera_imu_page.camera_imu_summary"}
"""Functions that are still longer. Shorten one, then take it off; nothing is added."""
MAX_PARAMETERS = 10
REPEATED: set[str] = set()
"""Class names that still occur more than once. Rename, then take it off; nothing is added."""

Documented = ast.Module | ast.ClassDef | ast.FunctionDef


def documented(tree: ast.AST) -> list[Documented]:
    return [node for node in ast.walk(tree) if isinstance(node, Documented)]


def functions(tree: ast.AST) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def is_kernel(function: ast.FunctionDef) -> bool:
    calls = [d.func for d in function.decorator_list if isinstance(d, ast.Call)]
    return any(isinstance(call, ast.Name) and call.id == "kernel" for call in calls)


def undocumented_kernels(tree: ast.AST) -> set[str]:
    return {f.name for f in functions(tree) if is_kernel(f) and not ast.get_docstring(f)}


def questions(tree: ast.AST) -> list[str]:
    first_lines = [(ast.get_docstring(node) or "\n").splitlines()[0] for node in documented(tree)]
    return [line for line in first_lines if line.split(" ")[0] in QUESTIONS]


def code_lines(function: ast.FunctionDef) -> int:
    """Lines of the body without docstrings, its own and those of functions inside."""
    docstrings = [node.body[0] for node in documented(function) if ast.get_docstring(node) is not None]
    last = function.body[-1].end_lineno or 0
    return last - function.body[0].lineno + 1 - sum((d.end_lineno or 0) - d.lineno + 1 for d in docstrings)


def long_functions(tree: ast.AST) -> set[str]:
    return {f.name for f in functions(tree) if code_lines(f) > MAX_LINES}


def wide_kernels(tree: ast.AST) -> set[str]:
    return {
        f.name
        for f in functions(tree)
        if is_kernel(f) and len(f.args.posonlyargs + f.args.args + f.args.kwonlyargs) > MAX_PARAMETERS
    }


def imported_modules(trees: Iterable[ast.AST]) -> set[str]:
    lines = [n for tree in trees for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    return {name for n in lines for name in (n.module, *(f"{n.module}.{a.name}" for a in n.names)) if name}


def repeated_classes(trees: Iterable[ast.AST]) -> set[str]:
    names = Counter(n.name for tree in trees for n in documented(tree) if isinstance(n, ast.ClassDef))
    return {name for name, times in names.items() if times > 1}


def test_every_kernel_has_a_docstring() -> None:
    assert sum(is_kernel(f) for tree in TREES.values() for f in functions(tree)) > 200
    assert {m: names for m, tree in TREES.items() if (names := undocumented_kernels(tree))} == {}


def test_no_first_line_is_a_question() -> None:
    assert {m: lines for m, tree in TREES.items() if (lines := questions(tree))} == {}


def test_functions_are_short() -> None:
    assert {f"{module}.{name}" for module, tree in TREES.items() for name in long_functions(tree)} == LONG


def test_kernels_have_few_parameters() -> None:
    assert {m: names for m, tree in TREES.items() if (names := wide_kernels(tree))} == {}


def test_every_module_of_kernels_is_tested() -> None:
    """By name: a kernel that is only reached through others may be wrong in what they don't ask of it."""
    kernels = {f"barsight.{m}" for m, tree in TREES.items() if any(map(is_kernel, functions(tree)))}
    assert kernels - imported_modules(TESTS) == set()


def test_class_names_occur_once() -> None:
    assert repeated_classes(TREES.values()) == REPEATED


def test_what_breaks_a_rule_is_found() -> None:
    body = "    x = 1\n" * MAX_LINES
    kernel = ast.parse(f'@kernel()\ndef bare():\n{body}    """no docstring"""\n')
    assert undocumented_kernels(kernel) == {"bare"} == long_functions(kernel)
    sound = ast.parse(f'@kernel()\ndef told():\n    """Whiten rows.\n\n    Units.\n    """\n{body}')
    assert undocumented_kernels(sound) == set() == long_functions(sound)
    names = ", ".join(f"x{i}" for i in range(MAX_PARAMETERS))
    wide = ast.parse(f"@kernel()\ndef even({names}):\n    pass\n@kernel()\ndef more({names}, y):\n    pass\n")
    assert wide_kernels(wide) == {"more"}
    assert questions(ast.parse('"""How it works."""\nclass A:\n    """Howitzer."""')) == ["How it works."]
    assert imported_modules([ast.parse("def f():\n    from a.b import c"), ast.parse("import d")]) == {
        "a.b",
        "a.b.c",
    }
    assert repeated_classes([ast.parse("class A: ...\nclass B: ..."), ast.parse("class A: ...")]) == {"A"}
