"""Every key of every settings file with wrong values: one line with the path of the key."""

from __future__ import annotations

import pytest

from foveasim.config import validate
from foveasim.config._models import models
from foveasim.errors import ConfigError
from foveasim.explore import schema_of
from foveasim.explore._schemas import FILES

#: Values of other types than most keys have; None and single values are valid for some.
WRONG = [[], {}, [[]], [1, "x"], {"kind": []}, {"kind": "none such"}, "none such", -1.5, True, None]


def resolve(schema, definitions):
    while "$ref" in schema or "allOf" in schema:  # older versions of pydantic write references as "allOf"
        (part,) = schema.get("allOf", [schema])
        schema = definitions[part["$ref"].rpartition("/")[2]]
    return schema


def example(schema, definitions):
    """Return the smallest value of a schema."""
    schema = resolve(schema, definitions)
    if "const" in schema:
        return schema["const"]
    if "enum" in schema:
        return schema["enum"][0]
    if "properties" in schema:
        required = [*schema.get("required", ()), *schema.get("anyOf", [{}])[0].get("required", ())]
        return {key: example(schema["properties"][key], definitions) for key in required}
    for key in ("oneOf", "anyOf"):
        if key in schema:
            return example(schema[key][0], definitions)
    if "prefixItems" in schema:
        return [example(item, definitions) for item in schema["prefixItems"]]
    if schema.get("type") == "array":
        return [example(schema["items"], definitions)] * schema.get("minItems", 0)
    return {"number": 1.0, "integer": 1, "string": "x", "boolean": True, "object": {}, "null": None}[schema["type"]]


def sections(schema, definitions, put=lambda section: section, visited=None):
    """Yield the keys and the smallest value of each section, and a function that puts a section into settings."""
    visited = set() if visited is None else visited
    if "$ref" in schema:
        if schema["$ref"] in visited:
            return
        visited.add(schema["$ref"])
    schema = resolve(schema, definitions)
    for alternative in () if "properties" in schema else (*schema.get("oneOf", ()), *schema.get("anyOf", ())):
        yield from sections(alternative, definitions, put, visited)
    if "items" in schema:
        yield from sections(schema["items"], definitions, lambda item: put([item]), visited)
    if "properties" in schema:
        smallest = example(schema, definitions)
        yield [*schema["properties"]], smallest, put
        for key, below in schema["properties"].items():
            yield from sections(below, definitions, lambda value, key=key: put({**smallest, key: value}), visited)


def wrong_settings(kind):
    """Yield the name of a key and settings in which it has a wrong value."""
    schema = schema_of(kind)
    for keys, smallest, put in sections(schema, schema.get("$defs", {})):
        yield from ((key, put({**smallest, key: value})) for key in keys for value in WRONG)


def model_of(kind):
    return getattr(models(), FILES[kind]) if isinstance(FILES[kind], str) else FILES[kind]


def message(kind, settings):
    """Return the message of the validation, None for valid settings."""
    try:
        validate(None, model_of(kind), settings)
    except ConfigError as error:
        return str(error)
    return None


@pytest.mark.slow(keep=("rules",))
@pytest.mark.parametrize("kind", FILES)
def test_wrong_values_give_one_line(kind):
    found = [(key, message(kind, settings)) for key, settings in wrong_settings(kind)]
    errors = [(key, line) for key, line in found if line is not None]

    assert len(found) >= 80
    assert len(errors) > 0.7 * len(found)
    assert [line for key, line in errors if "\n" in line or key not in line] == []


@pytest.mark.slow(keep=("rules", "sweep"))
@pytest.mark.parametrize("kind", FILES)
def test_validation_accepts_what_schema_accepts(kind):
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(schema_of(kind))
    rejected = [settings for _, settings in list(wrong_settings(kind))[::101] if message(kind, settings) is not None]

    assert rejected
    assert [settings for settings in rejected if validator.is_valid(settings)] == []
