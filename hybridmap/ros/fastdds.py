"""Buffers of Fast DDS that hold pictures: its own shared memory of 512 kB takes less than one of 640 x 480."""

from __future__ import annotations

import ctypes
import os
import tempfile
from pathlib import Path

_BUFFER_BYTES = 32 << 20
_NEWER, _OLDER = "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"
"""What Fast DDS 3 and 2 read; 3 takes the older name with a warning."""
_PROFILE = f"""<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>hybridmap_shared_memory</transport_id>
      <type>SHM</type>
      <segment_size>{_BUFFER_BYTES}</segment_size>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>hybridmap_udp</transport_id>
      <type>UDPv4</type>
      <sendBufferSize>{_BUFFER_BYTES}</sendBufferSize>
      <receiveBufferSize>{_BUFFER_BYTES}</receiveBufferSize>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="hybridmap" is_default_profile="true">
    <rtps>
      <userTransports>
        <transport_id>hybridmap_shared_memory</transport_id>
        <transport_id>hybridmap_udp</transport_id>
      </userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
</profiles>
"""


def provide_buffers() -> Path | None:
    """Name a profile with buffers of 32 MB in the environment, before rclpy begins.

    Shared memory belongs to the process that sends: drivers of cameras want the same profile.

    Returns:
        The profile, to be removed by the caller; None if the user has named one, which stays.
    """
    if any(os.environ.get(name) for name in (_NEWER, _OLDER, "FASTDDS_BUILTIN_TRANSPORTS")):
        return None
    with tempfile.NamedTemporaryFile("w", prefix="hybridmap-fastdds-", suffix=".xml", delete=False) as file:
        file.write(_PROFILE)
    os.environ[_NEWER if _has_version_3() else _OLDER] = file.name
    return Path(file.name)


def _has_version_3() -> bool:
    try:
        ctypes.CDLL("libfastdds.so")
    except OSError:
        return False
    return True
