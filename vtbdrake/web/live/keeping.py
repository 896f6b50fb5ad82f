"""What is kept of a session beyond its end: the last course as a test, the last drive as a trial of a study."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vtbdrake.web.live.session import SessionError

if TYPE_CHECKING:
    from vtbdrake.optimization import Problem
    from vtbdrake.optimization.records import DrivenTrial
    from vtbdrake.rollout.course import Course
    from vtbdrake.testbed import VirtualTestbed
    from vtbdrake.web.live.changes import Changes


class Keeping:
    """Writes what was set or driven last into files.

    Args:
        changes: What was set or driven.
        testbed: The testbed.
        problem: The problem whose quality judges what is driven by hand, or None.
        file_mode: Permissions of the files of a saved test; None: the permissions that the umask leaves.
    """

    def __init__(
        self, changes: Changes, testbed: VirtualTestbed, problem: Problem | None, *, file_mode: int | None
    ) -> None:
        self._changes, self._testbed, self._problem = changes, testbed, problem
        self._file_mode = file_mode

    def store_trial(self, study: str | os.PathLike[str], by: str | None) -> DrivenTrial:
        """Store the last drive as a trial.

        Args:
            study: The file of the study, which is begun if there is none.
            by: Who drove; None: the user of this process.
        """
        problem, driven = self._problem, self._changes.driven
        if problem is None:
            raise SessionError("this session has no problem, so that no study can have trials of it")
        if driven is None:
            raise SessionError("nothing has been driven: take over, and end the drive")
        parameters = problem.values_in(driven.course.start)
        with problem.study(study) as opened:
            return opened.add_driven(driven.course, driven.result, parameters=parameters, by=by)

    def save_test(self, path: Path, course: Course | None, watched: Sequence[str], *, tolerance: float) -> None:
        """Save a course as a test.

        Args:
            path: The file, test_NAME.py; the snapshot NAME.vtb comes beside it.
            course: The course, or None if there is none.
            watched: Addresses of the variables that it expects at the end, without a problem.
            tolerance: The relative difference that the test allows.
        """
        from vtbdrake.testing.saved_course import save_course

        self._changes.refuse_driven("saving")
        if course is None:
            raise SessionError("there is nothing to save: set something, or drive")
        task = None if self._problem is None else self._problem.task
        save_course(
            path, course, self._testbed, task=task, addresses=watched, tolerance=tolerance, mode=self._file_mode
        )
