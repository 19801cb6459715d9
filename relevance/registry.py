"""Variants by name: predicates, bodies, guides, planners, label policies, ... are registered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar

from relevance.errors import RelevanceError

T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Variants of one kind, by name, in the order in which they were registered."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        """What they are, for error messages: `predicate`, `body`, ..."""
        self._items: dict[str, T] = {}

    def register(self, name: str, item: T) -> T:
        """Add a variant; raises RelevanceError for a name that is taken."""
        if name in self._items:
            raise RelevanceError(f"{self.kind} {name!r} is registered already")
        self._items[name] = item
        return item

    def unregister(self, name: str) -> None:
        """Take a variant out again, as tests do."""
        del self._items[name]

    def __getitem__(self, name: str) -> T:
        """The variant of that name; raises RelevanceError with the names that there are."""
        try:
            return self._items[name]
        except KeyError:
            known = ", ".join(self._items)
            raise RelevanceError(f"unknown {self.kind} {name!r}, expected one of {known}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._items

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)
