"""JSON schemas as they are compared: what versions of pydantic write otherwise, and means the same, is left out."""


def without_defaults(schema):
    """A schema without what holds unsaid too: later pydantics write it of any mapping, earlier ones next to `const`."""
    if isinstance(schema, list):
        return [without_defaults(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    said = {key: value for key, value in schema.items() if (key, value) != ("additionalProperties", True)}
    if "const" in said:
        said.pop("enum", None)
    return {key: without_defaults(value) for key, value in said.items()}
