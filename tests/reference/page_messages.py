"""
Types of the messages that a page sends, in ``types.d.ts``.

They follow from the models in ``foveasim/studio/_messages``: ``python tests/reference/page_messages.py`` writes them again
after a change.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from foveasim.studio._messages.models import MESSAGES, CameraFrame

FILE = Path(__file__).parents[2] / "types.d.ts"
#: The part of the file between two headings.
PART = re.compile(r"(?<=// -- messages to the server).*?(?=// -- parts of pages)", re.DOTALL)
HEAD = """; Connection.send adds their numbers -------------------------------------------------------------
// python tests/reference/page_messages.py writes them, from foveasim/studio/_messages/models.py.
"""
NAMES = {"string": "string", "integer": "number", "number": "number", "boolean": "boolean", "null": "null"}


def type_of(schema, models):
    """Return the TypeScript type of a JSON schema."""
    if "$ref" in schema:
        return f"{{ {fields_of(models[schema['$ref'].rpartition('/')[2]], models)} }}"
    if "enum" in schema:
        return " | ".join(map(json.dumps, schema["enum"]))
    if "anyOf" in schema:
        return " | ".join(dict.fromkeys(type_of(each, models) for each in schema["anyOf"]))
    match schema.get("type"):
        case "array":
            item = type_of(schema["items"], models)
            return f"({item})[]" if " | " in item else f"{item}[]"
        case "object":
            return "{ [name: string]: unknown }"
        case kind:
            return NAMES.get(kind, "unknown")


def fields_of(schema, models):
    """Return the fields of a model; those that a page may leave undefined have this type, too."""
    fields = [
        f"{name}{'' if name in schema.get('required', ()) else '?'}: {type_of(each, models)}{' | undefined' * each.get('unchecked', False)}"
        for name, each in schema.get("properties", {}).items()
    ]
    return "; ".join([*fields, *["[name: string]: unknown"] * bool(schema.get("additionalProperties"))])


def types():
    """Return the part of the file."""
    lines = []
    for name, model in MESSAGES.items():
        schema = model.model_json_schema()
        fields = fields_of(schema, schema.get("$defs"))
        lines.append(f"  | {{ {'; '.join([f'do: {json.dumps(name)}', *[fields] * bool(fields)])} }}")
    header = fields_of(CameraFrame.model_json_schema(), None)
    union = "\n".join(lines)
    return f"{HEAD}\ntype Change =\n{union};\ninterface FrameHeader {{ {header} }}\n\n"


def with_types(text):
    """Return the text of the file with the part that follows from the models."""
    found, n = PART.subn(lambda _: types(), text)
    assert n == 1
    return found


if __name__ == "__main__":
    FILE.write_text(with_types(FILE.read_text("utf-8")), "utf-8")
