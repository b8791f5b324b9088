"""Errors that this package raises on purpose. All are ValueErrors."""


class TeamError(ValueError):
    """Base of the errors of this package."""


class InvalidArgumentError(TeamError):
    """An argument has a value that cannot be used, or that does not fit the others."""


class InvalidEnvironmentError(TeamError):
    """An environment, or a wrapper around it, violates the convention or does not fit the model."""


class InvalidFileError(TeamError):
    """A file is damaged, holds something else, or was written by another version."""


class UntrustedFileError(TeamError):
    """A file may run code when it is loaded, and nobody said that its author is trusted."""


class DivergedError(TeamError):
    """Parameters, losses or actions are not finite, or grew without limit."""


class UnusableParametersError(InvalidFileError, RuntimeError):
    """
    Parameters are not finite or do not fit the networks. Also a RuntimeError, since SB3's ``load`` takes a ValueError
    for the sign of an older file.
    """


class NoStateError(InvalidEnvironmentError):
    """An environment cannot provide its state."""
