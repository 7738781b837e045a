"""`fg-calib history`."""

from fg_calib.cli.output import Json, ResultFolder, show_result


def history(result: ResultFolder, as_json: Json = False) -> None:
    """Show the runs that a calibration came from."""
    from fg_calib.io import read_result
    from fg_calib.report import build_history, history_document

    found = read_result(result)
    runs = (*found.history, found.run)
    show_result(as_json, lambda: history_document(found.robot, runs), lambda: build_history(found.robot, runs))
