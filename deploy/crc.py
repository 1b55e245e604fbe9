"""The checksum at the end of the Go2's low-level frames."""

from __future__ import annotations

import zlib
from array import array

_REVERSED = bytes(int(f"{octet:08b}"[::-1], 2) for octet in range(256))


def crc32(words: bytes) -> int:
    """CRC-32 of a frame without its checksum: polynomial 0x04C11DB7, all ones to begin with.

    The firmware feeds little-endian 32-bit words, most significant bit first; `zlib.crc32` takes octets,
    least significant bit first. So each word goes in with its 32 bits reversed: the bits of every octet,
    then the octets of every word. The result comes out reversed and inverted.

    Args:
        words: the C struct of the message, padding included, without its last word; whole words.
    """
    swapped = array("I", words.translate(_REVERSED))
    swapped.byteswap()
    inverted = zlib.crc32(swapped) ^ 0xFFFFFFFF
    return int.from_bytes(inverted.to_bytes(4, "little").translate(_REVERSED), "big")
