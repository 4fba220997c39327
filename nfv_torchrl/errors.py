"""The errors this package raises on purpose; their messages name the culprit and the remedy."""


class ScenarioError(ValueError):
    """A scenario, a file or a config value that cannot be used."""


class ScenarioWarning(UserWarning):
    """Something of an input file that is not used, or was made up because the file lacks it."""


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be read, or does not fit what it is loaded into."""


class TrainingError(RuntimeError):
    """A run that cannot go on: numbers that are not finite, or no room on the disk."""


class AuditError(RuntimeError):
    """Written decisions that contradict the rules of the model or the numbers reported with them."""


LONGEST_WORD = 200
"""Letters of a path or a value that a message shows."""


def cut_words(text: str) -> str:
    """A message on one line, whose longest paths and values are cut; what to do about it stands behind them."""
    words = " ".join(text.split()).split(" ")
    return " ".join(word if len(word) <= LONGEST_WORD else f"{word[:LONGEST_WORD]}..." for word in words)


def one_line(error: BaseException) -> str:
    """What an error of a library says, in one line of at most 200 characters, for a message of ours."""
    return f"{' '.join(str(error).split()) or type(error).__name__:.200}"
