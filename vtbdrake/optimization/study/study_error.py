"""The error of studies."""


class StudyError(ValueError):
    """A file is no study, is damaged, belongs to another version or problem, or cannot be used."""
