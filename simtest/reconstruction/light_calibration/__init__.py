"""The picture side of `simtest calibrate light`: balls and plates in pictures, their highlights, page and files.

ball_search and outline find a ball, ball_highlights the highlights on it. observations holds what each picture shows.
run hands it to `simtest.calibration.lights`, write makes page and files of the result.
"""
