"""MLflow's web pages, started so that they open soon and on the comparison of runs."""

import os
import socket
import sys

from conflow.errors import ConfigError
from conflow.tracking import store

HOST = "127.0.0.1"


def serve(port: int) -> None:
    """Replace this process by MLflow's server of the store, on this machine alone; a store that is one has its own.

    Raises:
        ConfigError: the port is taken.
    """
    uri = store.store_uri()
    served = uri.startswith(("http://", "https://"))
    if not served:
        _probe(port)
    client = store.client()
    experiment = client.get_experiment_by_name(store.EXPERIMENT)
    assert experiment is not None
    # MLflow opens in another mode and on a list; this address is the classic view, on its charts.
    server = store.place().rstrip("/") if served else f"http://{HOST}:{port}"
    page = f"{server}/#/experiments/{experiment.experiment_id}/runs"
    print(f"{page}?workflowType=machine_learning&compareRunsMode=CHART", flush=True)
    if served:
        return
    command = ["-m", "mlflow", "server", "--host", HOST]
    # One worker, no job runner, no telemetry: a third of the start-up and a fifth of the memory of the defaults.
    quick = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    # No argument, which everybody on the machine could read: it may hold a password.
    kept = {"MLFLOW_BACKEND_STORE_URI": uri}
    arguments = [sys.executable, *command, "--port", str(port), "--workers", "1"]
    os.execve(sys.executable, arguments, os.environ | quick | kept)


def _probe(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ConfigError(f"port={port}: {error.strerror}, expected a free port; try port={port + 1}") from None
