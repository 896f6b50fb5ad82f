"""The text of an XML file, with its elements by place: what is changed leaves every other line where it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr


@dataclass(eq=False)
class XmlElement:
    """An element of a file.

    Attributes:
        tag: Its tag, with its prefix.
        attributes: Its attributes.
        line: The line in which it begins.
        parent: The element around it.
        begin: The offset in bytes of its start tag.
        tag_end: The offset behind its start tag.
        end: The offset behind it.
        children: The elements in it.
        text: The text in it, but for its children's.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    parent: XmlElement | None
    begin: int
    tag_end: int
    end: int = 0
    children: list[XmlElement] = field(default_factory=list)
    text: str = ""

    def iter(self, *tags: str) -> Iterator[XmlElement]:
        """Yield the element and all below it, or those with one of the tags, in the order of the file."""
        if not tags or self.tag in tags:
            yield self
        for child in self.children:
            yield from child.iter(*tags)

    def find(self, tag: str) -> XmlElement | None:
        """Return the first child with a tag."""
        return next((child for child in self.children if child.tag == tag), None)

    def get(self, name: str, default: str = "") -> str:
        """Return an attribute.

        Args:
            name: The name of the attribute.
            default: Its value where it is missing.
        """
        return self.attributes.get(name, default)


class XmlText:
    """The text of an XML file that is changed in place.

    Prefixes of namespaces stay in the tags, declared or not, as Drake's parsers read them.

    Raises:
        ValueError: It is no XML; the message names the line.
    """

    def __init__(self, text: bytes) -> None:
        self._bytes = text
        self._edits: list[tuple[int, int, bytes]] = []
        self.root = self._parse()

    def _parse(self) -> XmlElement:
        parser = expat.ParserCreate()
        parser.buffer_text = True
        roots: list[XmlElement] = []
        open_elements: list[XmlElement] = []

        def start(tag: str, attributes: dict[str, str]) -> None:
            begin, parent = parser.CurrentByteIndex, open_elements[-1] if open_elements else None
            element = XmlElement(tag, attributes, parser.CurrentLineNumber, parent, begin, self._end_of_tag(begin))
            (parent.children if parent else roots).append(element)
            open_elements.append(element)

        def end(_: str) -> None:
            element = open_elements.pop()
            is_empty = self._bytes[element.tag_end - 2 : element.tag_end] == b"/>"
            closing = parser.CurrentByteIndex
            element.end = element.tag_end if is_empty else self._bytes.index(b">", closing) + 1

        def data(text: str) -> None:
            if open_elements:
                open_elements[-1].text += text

        parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, data
        try:
            parser.Parse(self._bytes, True)
        except expat.ExpatError as error:
            raise ValueError(f"line {error.lineno}: {expat.ErrorString(error.code)}") from error
        return roots[0]

    def _end_of_tag(self, begin: int) -> int:
        quote = 0
        for place in range(begin, len(self._bytes)):
            byte = self._bytes[place]
            if quote:
                quote = 0 if byte == quote else quote
            elif byte in b"\"'":
                quote = byte
            elif byte == ord(">"):
                return place + 1
        return len(self._bytes)

    def set(self, element: XmlElement, **attributes: str | None) -> None:
        """Set attributes of an element; its start tag keeps its number of lines.

        Args:
            element: The element.
            attributes: The attributes; None removes one.
        """
        for name, value in attributes.items():
            element.attributes.pop(name, None)
            if value is not None:
                element.attributes[name] = value
        empty = self._bytes[element.tag_end - 2 : element.tag_end] == b"/>"
        pairs = "".join(f" {name}={quoteattr(value)}" for name, value in element.attributes.items())
        self._replace(element.begin, element.tag_end, f"<{element.tag}{pairs}{'/' if empty else ''}>")

    def set_text(self, element: XmlElement, text: str) -> None:
        """Set the text of an element.

        Args:
            element: The element, which has no children.
            text: The text.
        """
        element.text = text
        closing = self._bytes.rindex(b"</", element.tag_end, element.end)
        self._replace(element.tag_end, closing, escape(text))

    def remove(self, element: XmlElement) -> None:
        """Remove an element with all below it."""
        self._edits = [edit for edit in self._edits if not element.begin <= edit[0] < element.end]
        self._replace(element.begin, element.end, "")
        if element.parent is not None:
            element.parent.children.remove(element)

    def _replace(self, begin: int, end: int, text: str) -> None:
        lines = self._bytes.count(b"\n", begin, end) - text.count("\n")
        self._edits = [edit for edit in self._edits if edit[:2] != (begin, end)]
        self._edits.append((begin, end, text.encode() + b"\n" * lines))

    @property
    def changed(self) -> bool:
        """Whether it differs from the file."""
        return bool(self._edits)

    def encode(self) -> bytes:
        """Return the text with the changes."""
        parts, place = [], 0
        for begin, end, text in sorted(self._edits):
            parts += [self._bytes[place:begin], text]
            place = end
        return b"".join([*parts, self._bytes[place:]])
