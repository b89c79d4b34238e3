"""The errors that a user can meet; each message says what was expected, what came and what to do."""

BROKEN_ENVIRONMENT = 4
"""Exit code of a worker whose environment failed; for all else that a user can mend it is 2."""


class T4NMTDError(Exception):
    """Anything that a user can mend; command lines print its message and exit with code 2."""


class FormulaError(T4NMTDError):
    """A formula that cannot be parsed, or cannot serve as a task (unsatisfiable, valid)."""


class TranslationError(T4NMTDError):
    """A formula that the chosen translator could not turn into an automaton."""


class ConfigError(T4NMTDError):
    """A task file, configuration or command-line value that is unknown or out of range."""


class EnvError(T4NMTDError):
    """An environment that does not keep its side of the contract (labels, snapshots, spaces)."""


class ProtocolError(T4NMTDError):
    """A message that does not follow docs/protocol.md."""


class KeyFileError(T4NMTDError):
    """A key file or folder that is missing, damaged, readable by others, or in the way."""


class LeaseError(T4NMTDError):
    """A claim on a sub-task that the coordinator refused."""


class ImportNameError(T4NMTDError):
    """A module of somebody else's that Python finds under the name of one of our packages."""


class RunError(T4NMTDError):
    """A run directory that is missing, already in use, or damaged."""


class PolicyError(T4NMTDError):
    """An exported policy that is missing, damaged, or of another format version."""


class TrustError(T4NMTDError):
    """Code that a policy, a run or a coordinator names, and that this user has not said to run."""
