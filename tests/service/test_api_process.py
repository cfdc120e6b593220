"""The API process: what it may not load, and what its document promises."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from typing import Any

import pytest
from fastapi.routing import APIRoute

from sidelong_service.app import create_app
from sidelong_service.problems import MEDIA_TYPE, Problem
from sidelong_service.settings import ServiceSettings

HEAVY = [
    "open3d",
    "trimesh",
    "cv2",
    "scipy",
    "matplotlib",
    "numba",
    "rtde_control",
    "rtde_receive",
    "nxlib",
    "sidelong_drivers",
]
APP = create_app(ServiceSettings())


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    return json.loads(json.dumps(APP.openapi(), allow_nan=False))


def operations(document: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    return {(method.upper(), path): row for path, rows in document["paths"].items() for method, row in rows.items()}


def test_the_api_process_loads_neither_open3d_nor_drivers_nor_vendor_code() -> None:
    program = """
import json, sys
import sidelong_service.cli
import sidelong_service.server
from sidelong_service.app import create_app
from sidelong_service.settings import load_settings
create_app(load_settings()).openapi()
print(json.dumps(sorted(sys.modules)))
"""
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    loaded = {name.partition(".")[0] for name in json.loads(output)}
    assert "sidelong_service" in loaded
    assert not loaded & set(HEAVY)


def test_every_route_is_documented(document: dict[str, Any]) -> None:
    routes = {
        (method, route.path) for route in APP.routes if isinstance(route, APIRoute) for method in route.methods
    }  # fmt: skip
    assert len(routes) >= 10
    assert routes == set(operations(document))
    assert all(operation["description"] for operation in operations(document).values())


@pytest.mark.parametrize(
    ("route", "statuses"),
    [
        (("POST", "/v1/scans"), {"202", "404", "409", "413", "415", "422", "503"}),
        (("GET", "/v1/scans"), {"200", "422"}),
        (("GET", "/v1/scans/{scan_id}"), {"200", "404"}),
        (("GET", "/v1/scans/{scan_id}/events"), {"200", "404", "422"}),
        (("GET", "/v1/scans/{scan_id}/artifacts"), {"200", "404"}),
        (("GET", "/v1/scans/{scan_id}/artifacts/{name}"), {"200", "206", "400", "404", "416"}),
        (("GET", "/v1/cell"), {"200"}),
        (("POST", "/v1/cell/stop"), {"200", "504"}),
        (("GET", "/livez"), {"200"}),
        (("GET", "/readyz"), {"200", "503"}),
    ],
)
def test_each_answer_is_documented(document: dict[str, Any], route: tuple[str, str], statuses: set[str]) -> None:
    assert set(operations(document)[route]["responses"]) == statuses | {"default"}


def test_each_documented_error_is_a_problem(document: dict[str, Any]) -> None:
    for route, operation in operations(document).items():
        for status, response in operation["responses"].items():
            if status == "default" or (status >= "400" and route != ("GET", "/readyz")):
                assert list(response["content"]) == [MEDIA_TYPE]
                assert response["content"][MEDIA_TYPE]["schema"] == {"$ref": "#/components/schemas/Problem"}


def test_the_schema_of_a_problem_is_the_problem_we_send(document: dict[str, Any]) -> None:
    schema = document["components"]["schemas"]["Problem"]
    assert set(schema["properties"]) == set(Problem.model_fields)
    always = {"type", "title", "status", "detail", "code", "retryable", "operator_action"}
    assert set(schema["required"]) == always
    assert "FieldProblem" in document["components"]["schemas"]


def test_the_body_of_a_scan_is_described_with_its_limits(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    body = operations(document)["POST", "/v1/scans"]["requestBody"]
    assert body["required"] is True
    assert body["content"]["application/json"]["schema"] == {"$ref": "#/components/schemas/ScanRequest"}
    assert schemas["ScanRequest"]["additionalProperties"] is False
    assert schemas["PlanningSettings"]["properties"]["max_views"]["maximum"] == 100
    assert schemas["RecordedScene"]["properties"]["dataset"]["pattern"].startswith("^")


def test_all_references_lead_somewhere_and_nothing_is_promised_that_is_never_sent(document: dict[str, Any]) -> None:
    text = json.dumps(document)
    wanted = set(re.findall(r'"#/components/schemas/(\w+)"', text))
    assert wanted <= set(document["components"]["schemas"])
    assert "HTTPValidationError" not in text
    assert document["openapi"].startswith("3.1")
