"""Which environment variables a case may send to a server."""

import socket
from pathlib import Path

import pytest
from commands import bad
from test_service import HEADER, case, row, table

from livepde import cases
from livepde.cases.data import passwords_of


@pytest.mark.slow
@pytest.mark.parametrize("name", ["AWS_SECRET_ACCESS_KEY", "LIVEPDE_TOKEN"])
@pytest.mark.parametrize(
    ("key", "data", "output"),
    [
        ("data.mqtt", 'mqtt = {{ rows = ["a"], port = {port}, password_env = "{name}" }}', ""),
        (
            "data.opcua",
            'opcua = {{ url = "opc.tcp://127.0.0.1:{port}", columns = {{ a = "left" }}, '
            'password_env = "{name}" }}',
            "",
        ),
        (
            "output.mqtt",
            'file = "rows.csv"',
            'mqtt = {{ topic = "a", port = {port}, password_env = "{name}" }}\n',
        ),
        (
            "output.opcua",
            'file = "rows.csv"',
            'opcua = {{ url = "opc.tcp://127.0.0.1:{port}", columns = {{ a = "alpha" }}, '
            'password_env = "{name}" }}\n',
        ),
    ],
)
def test_a_case_sends_no_variable_that_the_user_has_not_allowed(
    here, monkeypatch, name, key, data, output
):
    """Nothing is connected, and the value is nowhere; the option of the command allows it."""
    monkeypatch.setenv(name, "a secret")
    Path("rows.csv").write_text(HEADER + table(*(row(k) for k in range(4))))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        port = server.getsockname()[1]
        path = Path(case(data.format(port=port, name=name)))
        path.write_text(path.read_text() + output.format(port=port, name=name))
        command = ("run", "case.toml", "--realtime", "--speed", "inf", "--out", "run")
        command = command if key.startswith("output") else command[:2]
        said = bad(*command)
        assert f"case.toml: {key}.password_env: the environment variable {name} would be" in said
        assert f"add --allow-env {name}" in said
        assert "a secret" not in said
        with pytest.raises(TimeoutError):
            server.accept()
        assert not Path("run").exists()
        loaded = cases.load("case.toml")
        assert passwords_of(loaded, True, [name]) == {key: "a secret"}
        assert passwords_of(loaded, False, [name] if key.startswith("output") else []) == (
            {key: "a secret"} if key.startswith("output") else {}
        )
