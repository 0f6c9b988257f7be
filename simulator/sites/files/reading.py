"""Messages about a world's files."""


def quoted(value: object) -> str:
    """A value of a file for a message: quoted, on one line, cut to the length of a name."""
    text = "null" if value is None else repr(value)
    return text if len(text) <= 48 else f"{text[:45]}..."


def json_fault(text: str, error: object) -> str:
    """Why a text is no JSON: what it is instead, if that is known, or the parser's words."""
    if text.lstrip().startswith("<"):
        return "it is XML, as KML and GPX are; save a map as GeoJSON in QGIS, a plan as .plan in QGroundControl"
    return str(error)
