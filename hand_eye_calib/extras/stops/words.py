"""Texts of the findings about stops: message, advice, probable cause."""

from hand_eye_calib.core.checks.words import FindingWords
from hand_eye_calib.core.results.records import Severity

WORDS = {
    "frozen_stops": FindingWords(
        "the {stream}'s pose is the same as before at {share:.0%} of the stops, while the other "
        "side moves",
        "read the pose anew at every stop, once it stands still; leave these stops out",
        "a pose that was stored before it was updated",
        code="frozen",
    ),
    "only_one_turns_at_stops": FindingWords(
        "the {stream}'s orientation is the same at all stops, while the other side turns by "
        "{degrees:.0f} deg in the median",
        "write the orientations of that side, too, and check the names of their columns",
        code="no_turning",
    ),
    "exchanged_files": FindingWords(
        "read as robot: {robot}; read as target: {target}; their names suggest the reverse, and "
        "exchanged files fit equally well",
        "give the poses of the hand first: hand_eye_calib arm {target} {robot}; if the order is "
        "right, rename the files",
        severity=Severity.WARNING,
        code="exchanged",
    ),
    "rows": FindingWords(
        "the rows of both sides do not belong together: they agree {text}",
        "pair each pose with the one of the same stop",
        "a row that is missing on one side, or files sorted by name",
    ),
    "angles": FindingWords(
        "{whose} rotations agree with the other's if their numbers are {detail}",
        "convert them, or name the columns of the file by what they are: roll_deg, pitch_deg, "
        "yaw_deg or rotvec_x, rotvec_y, rotvec_z",
    ),
    "unrelated_stops": FindingWords(
        "both sides rotate by different angles between the stops ({off_deg:.0f} deg in the median)",
        "check that both are of one session and row by row of the same stops, and what the numbers "
        "of the rotations are: angles or rotation vectors, degrees or radians",
        code="unrelated",
    ),
    "disagreeing_stops": FindingWords(
        "with the best mounting and target, {share:.0%} of the {part} of these stops remain "
        "unexplained",
        "check axes and conventions of both sides, that the camera and the target are fixed, and "
        "that rows belong together",
        "positions of another frame than the rotations, a target or a camera that moved, wrong "
        "parameters of the arm",
        code="unrelated",
    ),
    "moved_stops": FindingWords(
        "{what} moved by {size_mm:.0f} mm and {turn_deg:.1f} deg at about stop {number} of "
        "{n_stops}",
        "fasten it and record anew; or calibrate the stops before and after it alone",
        code="moved",
    ),
    "inverse_stops": FindingWords(
        "one of the two files has inverse poses (of the world in the sensor, such as a target in "
        "the camera)",
        "invert this file: parent_invert poses for the parent, child_invert poses for the child",
        code="inverse",
    ),
    "beside_or_inverse": FindingWords(
        "these files fit a camera beside the robot, or one on the hand if a file has inverse poses",
        "give setup beside; or, for a camera on the hand, child_invert poses if the second file "
        "has the target in the camera, parent_invert poses if the first has the base in the hand",
        code="inverse",
    ),
    "ambiguous_stops": FindingWords(
        "two conventions explain these stops alike: {given}, or {other}",
        "look up the convention of both sources and give the options of the first, or",
        code="ambiguous",
    ),
    "both_readings": FindingWords(
        "a camera on the hand and one beside the robot fit these stops equally well",
        "record more stops, with rotations about two axes: 15 or more are good",
        code="ambiguous",
    ),
    "setup": FindingWords(
        "the stops fit a camera {other}, not one {place}",
        "give setup {setup}; or, if the camera is {place}, one side or both have inverse poses: "
        "{todo}",
    ),
    "copied_stops": FindingWords(
        "the poses of the target are those of the robot: the camera and the target would be at the "
        "origins of hand and base",
        "give the poses of the target as the camera measured them",
        code="same_frame",
    ),
    "outlier_stops": FindingWords(
        "{count} of {n_stops} stops {do} not fit the others and {were} left out: {numbers}",
        "look at these stops: is the target detected well, and does the arm rest?",
        "a target that was detected mirrored, or a stop during a motion",
        severity=Severity.WARNING,
        code="outliers",
    ),
    "stop_units": FindingWords(
        "{whose} lengths are {unit}",
        "convert them to metres, or solve with",
        code="units",
    ),
    "target_scale": FindingWords(
        "the child's lengths must be multiplied by {scale:.4f} +/- {sigma:.4f}: they are "
        "{times:.4g} times as long as the parent's",
        "measure the target and give its size, or have the scale estimated",
        "a target of another size, or a wrong focal length",
        code="scale",
    ),
    "reading": FindingWords(
        "{what}: probably one side or both have inverse poses, or parent and child are exchanged",
        "{todo}; if none are inverse, give parent_invert none and child_invert none",
        code="inverse",
    ),
    "turning_about_one_axis": FindingWords(
        "the stops do not turn about two axes",
        "between the stops, turn the hand about at least two axes",
        severity=Severity.NOTE,
        code="one_axis",
    ),
}
