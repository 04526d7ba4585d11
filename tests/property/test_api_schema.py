"""schemathesis: whatever OpenAPI allows and forbids is sent, and every answer is one that OpenAPI describes."""

from __future__ import annotations

import os
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from servo_daemon.api.app import create_app
from servo_daemon.published.view import ModelChange
from tests.fake_daemon import T0, fake_daemon

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


class Quick:
    """Gains are not what is looked at here: whoever asks for them is told to come again."""

    async def run(self, function: Any, *arguments: object) -> Any:
        from servo_daemon.api.computing import busy

        raise busy("no computer in this test")

    def close(self) -> None:
        pass


def app() -> Any:
    daemon = fake_daemon()
    daemon.drives["axis1"].outcome = ModelChange(("coulomb_friction",), T0)
    return create_app(daemon, computer=Quick())


schema = schemathesis.openapi.from_asgi("/openapi.json", app()).exclude(path_regex="/stream$")
#: Of each route; `make check-api` asks for more.
EXAMPLES = int(os.environ.get("SERVO_API_EXAMPLES", "15"))
CHECKS = (not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance)


@schema.parametrize()
@settings(
    max_examples=int(os.environ.get("SERVO_API_EXAMPLES", "15")), deadline=None, suppress_health_check=list(HealthCheck)
)
def test_every_answer_is_one_that_is_described(case: Any) -> None:
    if "drive" in (case.path_parameters or {}):
        case.path_parameters["drive"] = "axis1"  # any other is 404
    answer = case.call()
    if answer.status_code in (414, 431):  # of any request, as the API's description says
        assert answer.headers["content-type"] == ["application/problem+json"]
        return
    # 503 is described where it may be answered: not ready, busy.
    checks = [c for c in CHECKS if not (c is not_a_server_error and answer.status_code == 503)]
    case.validate_response(answer, checks=checks)
