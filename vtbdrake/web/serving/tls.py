"""A certificate for pages that other devices of the network open."""

from __future__ import annotations

import ipaddress
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from vtbdrake.common.failures import one_line

_DAYS = 30


class TlsError(ValueError):
    """A certificate cannot be made or used, or this machine has no such address."""


@dataclass(frozen=True, kw_only=True)
class Tls:
    """Serves pages by https to the network, at one name of this machine.

    Attributes:
        name: The name or the address of this machine that other devices open.
        certificate: A file with its certificate, PEM; None for one that is made now; browsers warn about it.
        key: A file with the private key of the certificate, PEM, if it is not in the same file.
    """

    name: str
    certificate: Path | None = None
    key: Path | None = None

    @property
    def host(self) -> str:
        """Return the name as it stands in an address."""
        return f"[{self.name}]" if ":" in self.name else self.name

    def address(self) -> tuple[socket.AddressFamily, str]:
        """Return family and address of the interface to which the name leads.

        Raises:
            TlsError: It leads nowhere, or to all interfaces.
        """
        try:
            family, _, _, _, where = socket.getaddrinfo(self.name, None, type=socket.SOCK_STREAM)[0]
        except OSError as error:
            raise TlsError(f"{self.name!r} is no name or address of this machine ({one_line(error)})") from None
        address = str(where[0])
        if ipaddress.ip_address(address.partition("%")[0]).is_unspecified:
            raise TlsError(f"{self.name} is every interface: give the one address that the headset opens")
        return family, address

    @contextmanager
    def files(self) -> Iterator[tuple[str, str | None]]:
        """Hold the files of certificate and key; those that are made now are deleted at the end.

        Raises:
            TlsError: They cannot be read or made, or do not belong together.
        """
        with TemporaryDirectory(prefix="vtbdrake-tls-") as folder:  # Only its owner may enter.
            certificate, key = self.certificate, self.key
            if certificate is None:
                certificate, key = self._make(Path(folder))
            try:
                ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
            except (OSError, ssl.SSLError) as error:
                raise TlsError(f"the certificate {certificate} cannot be used: {one_line(error)}") from None
            yield str(certificate), None if key is None else str(key)

    def _make(self, folder: Path) -> tuple[Path, Path]:
        openssl = shutil.which("openssl")
        if openssl is None:
            raise TlsError(
                "there is no openssl to make a certificate with: install it, or give --certificate and --key"
            )
        try:
            ipaddress.ip_address(self.name)
            kind = "IP"
        except ValueError:
            kind = "DNS"
        certificate, key = folder / "certificate.pem", folder / "key.pem"
        arguments = [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
        arguments += ["-days", str(_DAYS), "-subj", "/CN=vtbdrake", "-addext", f"subjectAltName={kind}:{self.name}"]
        made = subprocess.run(
            [*arguments, "-out", str(certificate), "-keyout", str(key)], capture_output=True, text=True, check=False
        )
        if made.returncode != 0:
            raise TlsError(f"openssl makes no certificate for {self.name}: {made.stderr.strip()[-200:]}")
        return certificate, key
