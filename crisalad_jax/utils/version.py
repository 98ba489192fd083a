"""The version of this package, which its files record."""

VERSION = "0.2.0"
