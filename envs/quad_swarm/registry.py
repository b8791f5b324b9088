"""Names that users add to from outside: by assignment in a module of theirs, or by entry points of their package."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from quad_swarm.errors import shown, unknown_name

Entry = TypeVar("Entry")


class Registry(dict[str, Entry]):
    """Entries by name. `find` also knows those that installed packages offer as entry points ``NAME = module:object``,
    which it loads when they are first asked for. What a registry holds comes first.

    :param kind: kind of the entries, for error messages, such as "solver"
    :param group: group of the entry points, such as "quad_swarm.solvers"
    :param entries: the entries to begin with
    """

    def __init__(self, kind: str, group: str, entries: dict[str, Entry]):
        super().__init__(entries)
        self.kind = kind
        self.group = group

    def find(self, name: str, also: tuple[str, ...] = ()) -> Entry:
        """Return the entry of a name.

        :param name: the name
        :param also: what else is known under this kind, for the error message
        :raises ValueError: if there is none, or several packages offer one
        :raises ImportError: if a package offers one that cannot be loaded; the message names the package
        """
        if isinstance(name, str) and name not in self:
            found = {one.value: one for one in self._offers() if one.name == name}
            if len(found) > 1:
                packages = " and ".join(sorted(f"{_package(one)} ({one.value})" for one in found.values()))
                raise ValueError(
                    f"{self.kind} {name!r}: {packages} both have an entry point {self.group}: {name}; uninstall all "
                    "but one."
                )
            for offer in found.values():
                self[name] = self._load(offer)
        if not isinstance(name, str) or name not in self:
            raise unknown_name(self.kind, name, {*also, *self, *(one.name for one in self._offers())})
        return self[name]

    def _offers(self) -> list[EntryPoint]:
        try:
            return list(entry_points(group=self.group))
        except Exception as error:  # one damaged package hides all
            raise ImportError(
                f"The entry points of installed packages cannot be read ({shown(error)}): repair or uninstall the "
                "package that is damaged."
            ) from error

    def _load(self, offer: EntryPoint) -> Entry:
        try:
            return offer.load()
        except (Exception, SystemExit) as error:  # from foreign code
            raise ImportError(
                f"{_package(offer)} is installed, but its entry point {self.group}: {offer.name} = {offer.value} "
                f"cannot be loaded ({type(error).__name__}: {error}): repair or uninstall {_package(offer)}."
            ) from error


def _package(offer: EntryPoint) -> str:
    return (offer.dist.name if offer.dist is not None else None) or "a package"
