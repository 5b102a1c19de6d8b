"""What a satellite receiver says: NMEA 0183 sentences for tests."""

from datetime import datetime


def sentence(body: str) -> bytes:
    """Return a sentence with its checksum and its end."""
    checksum = 0
    for byte in body.encode("ascii"):
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode("ascii")


def _time(utc: datetime) -> str:
    return f"{utc:%H%M%S}.{utc.microsecond // 10000:02d}"


def rmc(utc: datetime, status: str = "A", mode: str = "A") -> bytes:
    """Return the recommended minimum data of a time."""
    place = "2830.0000,S,02100.0000,E" if status == "A" else ",,,"
    return sentence(f"GNRMC,{_time(utc)},{status},{place},0.01,,{utc:%d%m%y},,,{mode}")


def gga(utc: datetime, quality: int = 1) -> bytes:
    """Return the fix data of a time of day."""
    place = "2830.0000,S,02100.0000,E" if quality else ",,,"
    return sentence(f"GPGGA,{_time(utc)},{place},{quality},08,1.0,850.0,M,30.0,M,,")


def zda(utc: datetime) -> bytes:
    """Return time and date with a year of four digits."""
    return sentence(f"GPZDA,{_time(utc)},{utc:%d,%m,%Y},00,00")
