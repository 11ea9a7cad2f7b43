"""The picture side of `simtest calibrate light`: balls and plates in pictures, their highlights, page and files.

outline finds a ball, highlights the spots on it. run holds what each picture shows and hands it to
`simtest.calibration.lights`, page makes page and files of the result.
"""
