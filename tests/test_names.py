"""Names: no class name stands for two things."""

import ast
import collections

from tests.modules import module_files, parse


def test_no_class_name_is_used_twice():
    modules_by_class = collections.defaultdict(list)
    for module, path in module_files().items():
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef):
                modules_by_class[node.name].append(module)
    assert {name: modules for name, modules in modules_by_class.items() if len(modules) > 1} == {}
