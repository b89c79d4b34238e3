"""User-facing errors; each message says what was expected, what was found and what to do."""

BROKEN_ENVIRONMENT = 4
"""Exit code of a worker whose environment failed; for all else that a user can mend it is 2."""


class T4NMTDError(Exception):
    """An error the user can fix; commands print its message and exit with code 2."""


class FormulaError(T4NMTDError):
    """A formula with a syntax error, or unsuitable as a task (unsatisfiable, valid)."""


class TranslationError(T4NMTDError):
    """A formula that the chosen translator could not translate."""


class ConfigError(T4NMTDError):
    """A task file, configuration or command-line value that is unknown or out of range."""


class EnvError(T4NMTDError):
    """An environment that violates its contract (labels, snapshots, spaces)."""


class ProtocolError(T4NMTDError):
    """A message that violates docs/protocol.md."""


class KeyFileError(T4NMTDError):
    """A key file or folder that is missing, damaged, readable by others, or in the way."""


class LeaseError(T4NMTDError):
    """A sub-task claim refused by the coordinator."""


class ImportNameError(T4NMTDError):
    """A foreign module imported under the name of one of our packages."""


class RunError(T4NMTDError):
    """A run directory that is missing, already in use, or damaged."""


class PolicyError(T4NMTDError):
    """An exported policy that is missing, damaged, or of another format version."""


class TrustError(T4NMTDError):
    """Code named by a policy, run or coordinator that this user has not trusted."""
