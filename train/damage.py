"""What reading a damaged file of arrays or tensors raises."""

import lzma
import pickle
import struct
import zipfile
import zlib

# Both kinds of file are ZIP archives; which of these comes depends on the byte that is wrong.
DAMAGED = (
    *(OSError, ValueError, TypeError, LookupError, RuntimeError, EOFError, MemoryError, OverflowError, SyntaxError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, pickle.UnpicklingError),
)
