"""What reading a file that is damaged, cut off or of another format raises."""

import pickle
import struct
import tokenize
import zipfile
import zlib

try:
    from lzma import LZMAError
except ImportError:  # Python can be built without it
    _LZMA_ERRORS: tuple[type[Exception], ...] = ()
else:
    _LZMA_ERRORS = (LZMAError,)

READ_ERRORS: tuple[type[Exception], ...] = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, SyntaxError, TypeError,
    ValueError, pickle.UnpicklingError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
    *_LZMA_ERRORS,
)  # fmt: skip
"""What numpy, zipfile, pickle, Pillow, json and yaml make of such files: each is to become a `ValueError`."""
