"""Names of ROS 2 topics, importable without DDS."""

import re

ROS_NAMESPACE = r"^(/[A-Za-z_][A-Za-z0-9_]*)+$"  # such as /flcav/weather


def join_names(namespace: str, *parts: str) -> str:
    """Return a ROS name below a namespace; invalid characters become underscores.

    >>> join_names("/flcav", "cloud-fl-weather", "1st")
    '/flcav/cloud_fl_weather/_1st'
    """
    clean = (re.sub(r"[^A-Za-z0-9_]", "_", part) for part in parts)
    return "/".join([namespace, *(f"_{part}" if part[:1].isdigit() else part for part in clean)])
