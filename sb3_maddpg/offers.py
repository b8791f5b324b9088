"""What installed packages offer through entry points. A broken offer is refused with the name of its package."""

from __future__ import annotations

from importlib.metadata import EntryPoint, distributions, entry_points
from typing import Any

from sb3_maddpg.utils import told


class OfferError(ImportError):
    """Raised for what an installed package offers if it is broken."""


def offers(group: str) -> list[EntryPoint]:
    """
    :param group: last part of the name of the entry points' group, e.g. "evaluators"
    :return: the entry points of all installed packages
    :raises OfferError: if those of a package cannot be read; the message names the package
    """
    try:
        return list(entry_points(group=f"sb3_maddpg.{group}"))
    except Exception as error:  # one damaged package hides all
        raise OfferError(
            f"The entry points of {_unreadable()} cannot be read ({told(error)}): repair or uninstall it."
        ) from error


def offer_named(group: str, name: str) -> EntryPoint | None:
    """
    :param group: see ``offers``
    :param name: name of the entry point, e.g. an environment
    :return: the entry point, None if there is none
    :raises OfferError: if packages offer different objects under this name
    """
    found = {one.value: one for one in offers(group) if one.name == name}
    if len(found) > 1:
        packages = " and ".join(sorted(f"{package_of(one)} ({one.value})" for one in found.values()))
        raise OfferError(
            f"{packages} both have an entry point sb3_maddpg.{group}: {name}, so that the choice is open: uninstall "
            "all but one."
        )
    return next(iter(found.values()), None)


def load_offer(offer: EntryPoint) -> Any:
    """
    Load what an installed package offers.

    :param offer: an entry point
    :return: the object
    :raises OfferError: if it cannot be loaded; the message names the package
    """
    try:
        return offer.load()
    except (Exception, SystemExit) as error:  # from foreign code
        raise broken(offer, f"cannot be loaded ({told(error)})") from error


def broken(offer: EntryPoint, problem: str) -> OfferError:
    """
    :param offer: an entry point
    :param problem: what is wrong with it
    :return: an error that names the package
    """
    package = package_of(offer)
    return OfferError(
        f"{package} is installed, but its entry point {offer.group}: {offer.name} = {offer.value} {problem}: repair or "
        f"uninstall {package}."
    )


def package_of(offer: EntryPoint) -> str:
    """
    :param offer: an entry point
    :return: name of the package that it belongs to
    """
    return (offer.dist.name if offer.dist is not None else None) or "a package"


def _unreadable() -> str:
    for distribution in distributions():
        try:
            list(distribution.entry_points)
        except Exception:
            return distribution.name or "a package"
    return "an installed package"
