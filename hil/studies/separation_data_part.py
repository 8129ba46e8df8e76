"""The recording itself, shown: how much there is of it, its noise, and Fig. 3."""

from __future__ import annotations

from hil.studies.result import Part, Table
from hil.studies.separation_data import Recording, mean_noise, pose_key, sample_noise
from hil.studies.separation_figures import joint_angles
from hil.studies.separation_text import joint_titles, with_mean


def data_part(recording: Recording, *, figures: bool) -> Part:
    """What was recorded."""
    dwells = recording.dwells
    poses = len({pose_key(condition) for condition in dwells.conditions})
    text = f"{len(dwells.conditions)} dwells of {poses} poses, {len(dwells)} samples at rest."
    table = Table(
        "table-noise",
        f"Noise of the {dwells.effort_kind} at rest, standard deviation [{dwells.effort_unit}]",
        ("of", *joint_titles(dwells.n_joints), "mean"),
        (
            ("a sample about the mean of its dwell", *with_mean(sample_noise(dwells))),
            ("the mean of a dwell", *with_mean(mean_noise(dwells))),
        ),
        "From the scatter of the samples within their dwell; an error that all samples of a dwell "
        "share does not show in it.",
    )
    drawn = (joint_angles(recording.whole),) if figures else ()
    return Part("The recording", "", (text,), (table,), drawn)
