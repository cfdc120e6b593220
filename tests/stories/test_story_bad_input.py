"""A clumsy and a hostile client: whatever comes is refused with a reason, and the cell is as it was before."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import damaged_recordings as damage
import httpx
import pytest
from service_process import QUICK_RECIPE, QUICK_SCAN, ServiceProcess, small_cell

JSON = {"Content-Type": "application/json"}
RECORDING = {"dataset": "robi", "object": "Tube_fitting", "scene": 1, "reference": "view_4"}
REFERENCE_ONLY = QUICK_RECIPE | {"planning": {"max_views": 0}}
HUGE = 10**400

# what a damaged recording is refused for when a scan of it is asked for: kind, and words of the detail
REFUSED: dict[str, tuple[Callable[[Path], None], str, list[str]]] = {
    "nan-pose": (damage.put_nan_into_a_pose, "pose", ["DEPTH_view_4.json", "finite"]),
    "scaled-pose": (damage.scale_a_pose, "pose", ["DEPTH_view_4.json"]),
    "no-list": (damage.remove_list_of_views, "dataset", ["list.txt", "missing"]),
    "metres": (damage.write_mesh_in_metres, "mesh", ["Tube_fitting.stl", "limits 0.5 to 5000 mm", "metres"]),
    "open-mesh": (damage.open_mesh, "mesh", ["Tube_fitting.stl", "watertight", "limit 1 %"]),
    "cut-mesh": (damage.cut_mesh, "mesh", ["Tube_fitting.stl"]),
}
# and what a scan of it fails for
FAILED: dict[str, tuple[Callable[[Path], None], str, list[str]]] = {
    "truncated-depth": (damage.truncate_reference_depth, "image", ["DEPTH_view_4.png", "truncated"]),
    "no-depth": (damage.remove_reference_depth, "image", ["DEPTH_view_4.png", "missing"]),
    "zero-depth": (damage.empty_reference_depth, "depth", ["0 of 327680"]),
    "no-image": (damage.remove_reference_image, "image", ["view_4", "no left image"]),
    "small-image": (damage.shrink_reference_image, "image", ["LEFT_view_4.bmp", "320x256 px", "640x512 px"]),
    "nan-intrinsics": (damage.break_intrinsics, "dataset", ["Ensenso_LEFT.yml", "fx is nan", "finite"]),
}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service that knows the recorded scene and its damaged copies."""
    folder = tmp_path_factory.mktemp("bad_input")
    copies = {name: row[0] for name, row in (REFUSED | FAILED).items()}
    copies |= {"grey": damage.grey_reference_image, "later": damage.truncate_all_other_depths}
    datasets = {name: str(damage.damaged(folder / name, change)) for name, change in copies.items()}
    gone = {"gone": str(folder / "nonesuch")}
    running = ServiceProcess(folder, small_cell(), datasets={"robi": str(damage.ROBI)} | datasets | gone)
    yield running
    running.close()


@pytest.fixture(scope="module")
def ended(service: ServiceProcess) -> dict[str, Any]:
    """A scan that has files."""
    return service.run_quick_scan()


@pytest.fixture
def unharmed(service: ServiceProcess) -> Iterator[None]:
    """The cell is idle afterwards, and neither the list of scans nor the data directory has changed."""
    before = kept(service)
    yield
    cell = service.http.get("/v1/cell").json()
    assert (cell["state"], cell["may_start"], cell["reasons"]) == ("idle", True, [])
    assert kept(service) == before


def kept(service: ServiceProcess) -> tuple[list[str], list[Path]]:
    scans = service.http.get("/v1/scans", params={"limit": 200}).json()["scans"]
    return [scan["id"] for scan in scans], sorted((service.data / "scans").rglob("*"))


def problem_in(answer: httpx.Response, status: int, kind: str) -> dict[str, Any]:
    """Return the problem of an answer, after checking its form."""
    assert answer.status_code == status, answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    body = json.loads(answer.content, parse_constant=_no_json)
    check_problem(body, kind)
    assert body["status"] == status
    return body


def check_problem(body: dict[str, Any], kind: str) -> None:
    assert body["type"] == f"urn:sidelong:problem:{kind}", body
    assert all(isinstance(body[name], str) and body[name] for name in ("title", "detail", "operator_action"))
    assert isinstance(body["code"], int)
    assert isinstance(body["retryable"], bool)


def _no_json(constant: str) -> NoReturn:
    raise AssertionError(f"{constant} is not JSON")


def post(service: ServiceProcess, content: bytes, headers: dict[str, str] = JSON) -> httpx.Response:
    return service.http.post("/v1/scans", content=content, headers=headers)


def recorded(**changes: Any) -> bytes:
    return json.dumps({"recording": RECORDING | changes, "recipe": REFERENCE_ONLY}).encode()


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    "content",
    [
        b"", b"not json", b"{", b"null", b"5", b'"tube_fitting"', b"[]", b"\xff\xfe\x00", b"\x00", b"[" * 100_000,
        b'{"part": "\\ud800"}', b"{'part': 'tube_fitting'}", b'{"part": "tube_fitting"} {}',
    ],
)  # fmt: skip
def test_a_body_that_is_no_json_object_is_refused(service: ServiceProcess, content: bytes) -> None:
    body = problem_in(post(service, content), 422, "validation")
    assert body["errors"][0]["field"] == "body"


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "true", "false", '"0.1"', "null", "[1]"])
@pytest.mark.parametrize("field", ["depth_exposure_s", "move_deadline_s"])
def test_what_is_no_finite_number_is_refused(service: ServiceProcess, field: str, number: str) -> None:
    content = f'{{"part": "tube_fitting", "recipe": {{"{field}": {number}}}}}'
    body = problem_in(post(service, content.encode()), 422, "validation")
    assert f"recipe.{field}" in body["detail"]
    assert [error["field"] for error in body["errors"]] == [f"recipe.{field}"]


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        ({"planning": {"max_views": 101}}, ["planning.max_views", "101", "less than or equal to 100"]),
        ({"planning": {"max_views": -1}}, ["planning.max_views", "-1", "greater than or equal to 0"]),
        ({"planning": {"max_views": 1.5}}, ["planning.max_views", "1.5", "valid integer"]),
        ({"planning": {"max_views": True}}, ["planning.max_views", "True", "valid integer"]),
        ({"planning": {"max_views": "2"}}, ["planning.max_views", "'2'", "valid integer"]),
        ({"planning": {"seed": 2**32}}, ["planning.seed", "4294967296", "less than 4294967296"]),
        ({"planning": {"seed": HUGE}}, ["planning.seed", "less than 4294967296"]),
        ({"planning": {"seed": -HUGE}}, ["planning.seed", "greater than or equal to 0"]),
        ({"planning": {"stride_px": 0}}, ["planning.stride_px", "got 0", "greater than or equal to 1"]),
        ({"planning": {"gain_threshold_share": 1.5}}, ["gain_threshold_share", "1.5", "less than or equal to 1"]),
        ({"planning": {"gain_threshold_px": -1}}, ["gain_threshold_px", "-1", "greater than or equal to 0"]),
        ({"planning": {"strategy": "best"}}, ["planning.strategy", "'best'", "'nbv'"]),
        ({"detection": {"view_step_deg": 1}}, ["detection.view_step_deg", "got 1", "greater than or equal to 5"]),
        ({"detection": {"cell_px": 64}}, ["detection.cell_px", "64", "less than or equal to 32"]),
        ({"detection": {"match_threshold": 100}}, ["match_threshold", "100", "less than or equal to 50"]),
        ({"detection": {"distance_m": [0.5]}}, ["detection.distance_m", "Field required"]),
        ({"detection": {"distance_m": [0.9, 0.5]}}, ["detection", "0.9", "must not exceed"]),
        ({"light": {"gamma": 0}}, ["light.gamma", "got 0", "greater than 0"]),
        ({"light": {"intensity": -3.0}}, ["light.intensity", "-3.0", "greater than 0"]),
        ({"light": {"shadows": "some"}}, ["light.shadows", "'some'", "'all'"]),
        ({"light": {"materials": {"x": {"k_d": -1, "k_s": 0, "n": 1}}}}, ["materials.x.k_d", "-1", "equal to 0"]),
        ({"sensing": {"z_min": 256}}, ["sensing.z_min", "256", "less than or equal to 255"]),
        ({"sensing": {"z_min": 200, "z_max": 100}}, ["sensing", "z_min is 200", "z_max, which is 100"]),
        ({"image_exposure_s": 11}, ["image_exposure_s", "11", "less than or equal to 10"]),
        ({"depth_exposure_s": 1e-7}, ["depth_exposure_s", "1e-07", "equal to 0.000001"]),
        ({"move_deadline_s": 0}, ["move_deadline_s", "got 0", "greater than 0"]),
        ({"nonsense": 1}, ["recipe.nonsense", "not permitted"]),
        ({"planning": {"nonsense": {"deep": [1]}}}, ["recipe.planning.nonsense", "not permitted"]),
        ({"planning": [1, 2]}, ["recipe.planning", "object"]),
        ([], ["recipe", "object"]),
    ],
)  # fmt: skip
def test_a_setting_out_of_its_range_is_refused_with_field_value_and_limit(
    service: ServiceProcess, recipe: Any, words: list[str]
) -> None:
    content = json.dumps({"part": "tube_fitting", "recipe": recipe}).encode()
    body = problem_in(post(service, content), 422, "validation")
    assert all(word in body["detail"] for word in words), body["detail"]


@pytest.mark.usefixtures("unharmed")
def test_many_bad_fields_are_all_named_but_not_all_in_one_line(service: ServiceProcess) -> None:
    recipe = {"planning": {"max_views": -1, "seed": -1, "stride_px": -1}, "light": {"gamma": -1}, "x": 1}
    body = problem_in(post(service, json.dumps({"part": "x", "recipe": recipe}).encode()), 422, "validation")
    assert len(body["errors"]) == 5
    assert body["detail"].endswith("and 2 more")


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    ("content", "status", "kind", "words"),
    [
        (b"{}", 422, "validation", ["either part", "or recording"]),
        (b'{"part": null}', 422, "validation", ["either part"]),
        (json.dumps({"part": "tube_fitting", "recording": RECORDING}).encode(), 422, "validation", ["either part"]),
        (b'{"part": "tube_fitting", "speed": 9}', 422, "validation", ["speed", "not permitted"]),
        (b'{"part": 7}', 422, "validation", ["part", "got 7", "string"]),
        (b'{"part": "nonesuch"}', 404, "unknown-name", ["'nonesuch'", "known are tube_fitting"]),
        (b'{"part": "tube_fitting.stl"}', 404, "unknown-name", ["tube_fitting.stl"]),
        (recorded(dataset="nonesuch"), 404, "unknown-name", ["'nonesuch'", "robi"]),
        (recorded(dataset="gone"), 404, "unknown-name", ["no such data set folder"]),
        (recorded(object="nonesuch"), 404, "unknown-name", ["'nonesuch'", "known are Tube_fitting"]),
        (recorded(object="cam"), 404, "unknown-name", ["'cam'"]),
        (recorded(scene=7), 404, "unknown-name", ["scene 7", "known are 1"]),
        (recorded(scene=-1), 422, "validation", ["recording.scene", "-1", "greater than or equal to 0"]),
        (recorded(scene=HUGE), 422, "validation", ["recording.scene", "less than or equal to 1000000"]),
        (recorded(scene=True), 422, "validation", ["recording.scene", "True"]),
        (recorded(scene="1"), 422, "validation", ["recording.scene", "'1'"]),
        (recorded(scene=1.5), 422, "validation", ["recording.scene", "1.5"]),
        (recorded(reference="view_99"), 404, "unknown-name", ["'view_99'", "known are view_0"]),
        (recorded(path="/etc"), 422, "validation", ["recording.path", "not permitted"]),
        (b'{"recording": {"dataset": "robi"}}', 422, "validation", ["recording.object", "required"]),
        (b'{"recording": "robi"}', 422, "validation", ["recording", "object"]),
    ],
)
def test_a_scan_of_what_is_not_there_is_refused_by_name(
    service: ServiceProcess, content: bytes, status: int, kind: str, words: list[str]
) -> None:
    body = problem_in(post(service, content), status, kind)
    assert all(word in body["detail"] for word in words), body["detail"]


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    "name",
    [
        "../robi",
        "a/b",
        "",
        "..",
        ".",
        "/etc/passwd",
        "a" * 200,
        "a\\b",
        "a\x00b",
        "a\n",
        " a",
        "a b",
        "%2e%2e",
        "ü",
        "*",
    ],
)
def test_a_name_that_could_be_a_path_is_refused(service: ServiceProcess, name: str) -> None:
    contents = {"part": json.dumps({"part": name}).encode()}
    contents |= {f"recording.{field}": recorded(**{field: name}) for field in ("dataset", "object", "reference")}
    for field, content in contents.items():
        body = problem_in(post(service, content), 422, "validation")
        assert body["errors"][0]["field"] == field
        assert "should match pattern" in body["detail"]


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    ("content", "headers", "status", "kind", "words"),
    [
        (b'{"part": "nonesuch"}', {"Content-Type": "text/plain"}, 415, "media-type", ["text/plain"]),
        (b'{"part": "nonesuch"}', {}, 415, "media-type", ["not given"]),
        (b"part=nonesuch", {"Content-Type": "application/x-www-form-urlencoded"}, 415, "media-type", ["form"]),
        (b'{"part": "nonesuch"}', {"Content-Type": "application/jsonl"}, 415, "media-type", ["jsonl"]),
        (b'{"part": "x"}', {"Content-Type": "APPLICATION/JSON; charset=utf-8"}, 404, "unknown-name", ["'x'"]),
        (b" " * 262_145, JSON, 413, "too-large", ["262144 bytes"]),
        (b'{"part": "' + b"a" * 300_000 + b'"}', JSON, 413, "too-large", ["262144 bytes"]),
        (b" " * 262_120 + b'{"part": "nonesuch"}', JSON, 404, "unknown-name", ["nonesuch"]),
    ],
)  # fmt: skip
def test_media_type_and_size_of_the_body_are_checked(
    service: ServiceProcess, content: bytes, headers: dict[str, str], status: int, kind: str, words: list[str]
) -> None:
    body = problem_in(post(service, content, headers), status, kind)
    assert all(word in body["detail"] for word in words), body["detail"]


@pytest.mark.usefixtures("unharmed")
def test_a_body_without_end_is_refused_before_it_fills_the_memory(service: ServiceProcess) -> None:
    with httpx.Client(base_url=service.url) as http:
        answer = http.post("/v1/scans", content=(b" " * 65_536 for _ in range(64)), headers=JSON)
    problem_in(answer, 413, "too-large")


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    ("method", "path", "status", "kind"),
    [
        ("GET", "/nowhere", 404, "not-found"),
        ("GET", "/v1", 404, "not-found"),
        ("POST", "/v1/scans/", 404, "not-found"),
        ("GET", "/v1/scans/..%2f..%2fetc", 404, "not-found"),
        ("PUT", "/v1/scans", 405, "method-not-allowed"),
        ("DELETE", "/v1/scans", 405, "method-not-allowed"),
        ("GET", "/v1/cell/stop", 405, "method-not-allowed"),
        ("POST", "/v1/cell", 405, "method-not-allowed"),
        ("OPTIONS", "/v1/scans", 405, "method-not-allowed"),
        ("GET", "/v1/scans/nonesuch", 404, "not-found"),
        ("GET", "/v1/scans/%00", 404, "not-found"),
        ("GET", "/v1/scans/%ff", 404, "not-found"),
        ("GET", f"/v1/scans/{'a' * 5000}", 404, "not-found"),
        ("GET", "/v1/scans/nonesuch/events", 404, "not-found"),
        ("GET", "/v1/scans/nonesuch/artifacts", 404, "not-found"),
        ("GET", "/v1/scans/nonesuch/artifacts/depth.png", 404, "not-found"),
    ],
)
def test_unknown_paths_methods_and_scans_are_problems_too(
    service: ServiceProcess, method: str, path: str, status: int, kind: str
) -> None:
    body = problem_in(service.http.request(method, path), status, kind)
    assert len(body["detail"]) < 300


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("limit=0", ["query.limit", "'0'", "greater than or equal to 1"]),
        ("limit=201", ["query.limit", "'201'", "less than or equal to 200"]),
        ("limit=x", ["query.limit", "'x'", "integer"]),
        ("limit=", ["query.limit", "integer"]),
        ("limit=1e2", ["query.limit", "'1e2'", "integer"]),
        ("limit=" + "9" * 5000, ["query.limit"]),
        ("cursor=0", ["query.cursor", "'0'", "greater than or equal to 1"]),
        ("cursor=-5", ["query.cursor", "'-5'"]),
        ("cursor=nonsense", ["query.cursor", "'nonsense'"]),
        ("cursor=9223372036854775808", ["query.cursor", "less than 9223372036854775808"]),
        ("cursor=" + "9" * 5000, ["query.cursor"]),
    ],
)
def test_a_page_that_cannot_be_is_refused(service: ServiceProcess, query: str, words: list[str]) -> None:
    body = problem_in(service.http.get(f"/v1/scans?{query}"), 422, "validation")
    assert all(word in body["detail"] for word in words), body["detail"]
    assert len(body["detail"]) < 300


def test_a_page_before_all_scans_is_empty(service: ServiceProcess) -> None:
    assert service.http.get("/v1/scans?cursor=1").json() == {"scans": [], "next_cursor": None}
    assert service.http.get("/v1/scans?cursor=9223372036854775807").status_code == 200


@pytest.mark.parametrize("last", ["x", "-1", "1.5", "NaN", "9223372036854775808", "9" * 400, ""])
def test_a_last_event_id_that_is_none_is_refused(service: ServiceProcess, ended: dict[str, Any], last: str) -> None:
    answer = service.http.get(f"/v1/scans/{ended['id']}/events", headers={"Last-Event-ID": last})
    body = problem_in(answer, 422, "validation")
    assert "header.last-event-id" in body["detail"]


def test_a_last_event_id_after_the_end_gives_no_events(service: ServiceProcess, ended: dict[str, Any]) -> None:
    assert list(service.client.events(ended["id"], after=2**63 - 1)) == []


@pytest.mark.parametrize(
    "name",
    [
        "nonesuch.png", "DEPTH.PNG", "depth.png%00", "depth.png/", ".depth.png.part", "%2e%2e", "..%2fdepth.png",
        "..%2f..%2fsidelong.sqlite", "..%2f..%2f..%2f..%2f..%2fetc%2fpasswd", "%2fetc%2fpasswd", "view_00.npz%20",
    ],
)  # fmt: skip
def test_a_file_that_is_none_of_the_scan_is_not_found(
    service: ServiceProcess, ended: dict[str, Any], name: str
) -> None:
    problem_in(service.http.get(f"/v1/scans/{ended['id']}/artifacts/{name}"), 404, "not-found")


@pytest.mark.parametrize(
    ("wanted", "status", "kind"),
    [
        ("bytes=5-2", 400, "bad-request"),
        ("bytes=a-b", 400, "bad-request"),
        ("nonsense", 400, "bad-request"),
        ("bytes=99999999-", 416, "range"),
    ],
)
def test_a_range_that_cannot_be_is_a_problem_too(
    service: ServiceProcess, ended: dict[str, Any], wanted: str, status: int, kind: str
) -> None:
    path = f"/v1/scans/{ended['id']}/artifacts/depth.png"
    answer = service.http.get(path, headers={"Range": wanted})
    assert wanted in problem_in(answer, status, kind)["detail"]
    part = service.http.get(path, headers={"Range": "bytes=0-3"})
    assert (part.status_code, part.content) == (206, b"\x89PNG")
    if status == 416:
        size = next(artifact["size_bytes"] for artifact in ended["artifacts"] if artifact["name"] == "depth.png")
        assert answer.headers["Content-Range"] == f"bytes */{size}"


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize("host", ["attacker.example", "attacker.example:8000", "127.0.0.1.nip.example", "x"])
def test_a_foreign_host_name_is_refused(service: ServiceProcess, host: str) -> None:
    body = problem_in(service.http.get("/v1/cell", headers={"Host": host}), 421, "host")
    assert host in body["detail"]


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:80", "127.0.0.1", "127.0.0.1:1", "[::1]:8000"])
def test_this_machine_s_names_and_addresses_are_answered(service: ServiceProcess, host: str) -> None:
    assert service.http.get("/v1/cell", headers={"Host": host}).status_code == 200


@pytest.mark.usefixtures("unharmed")
@pytest.mark.parametrize("name", REFUSED)
def test_a_damaged_recording_is_refused_with_file_value_and_limit(service: ServiceProcess, name: str) -> None:
    _, kind, words = REFUSED[name]
    body = problem_in(post(service, recorded(dataset=name)), 422, kind)
    assert all(word in body["detail"] for word in words), body["detail"]


@pytest.mark.parametrize("name", FAILED)
def test_a_scan_of_damaged_images_fails_with_file_value_and_limit(service: ServiceProcess, name: str) -> None:
    _, kind, words = FAILED[name]
    scan = service.ended(post(service, recorded(dataset=name)).raise_for_status().json()["id"])
    assert (scan["state"], scan["finish_reason"], scan["views"]) == ("failed", None, [])
    check_problem(scan["problem"], kind)
    assert all(word in scan["problem"]["detail"] for word in words), scan["problem"]["detail"]
    assert not list(service.data.rglob("*.part"))
    cell = service.http.get("/v1/cell").json()
    assert (cell["state"], cell["may_start"]) == ("idle", True)


def test_a_later_view_that_is_damaged_fails_the_scan_and_keeps_what_it_has(service: ServiceProcess) -> None:
    content = json.dumps({"recording": RECORDING | {"dataset": "later"}, "recipe": QUICK_RECIPE}).encode()
    scan = service.ended(post(service, content).raise_for_status().json()["id"])
    assert scan["state"] == "failed"
    check_problem(scan["problem"], "image")
    assert "truncated" in scan["problem"]["detail"]
    assert [view["view"] for view in scan["views"]] == ["view_4"]
    names = {artifact["name"] for artifact in scan["artifacts"]}
    results = {"depth.png", "sigma.png", "state.png", "depth.npz", "cloud.ply", "mesh.ply", "poses.json", "report.json"}
    results |= {"poses.png", "picture.png"}
    assert names == {"view_00.npz"} | results


def test_an_image_without_a_part_is_a_normal_end(service: ServiceProcess) -> None:
    scan = service.ended(post(service, recorded(dataset="grey")).raise_for_status().json()["id"])
    assert (scan["state"], scan["finish_reason"], scan["problem"]) == ("succeeded", "no_objects", None)
    assert [(view["objects"], view["missing_px"], view["candidates"]) for view in scan["views"]] == [(0, 0, [])]
    assert {"depth.png", "report.json", "picture.png"} <= {artifact["name"] for artifact in scan["artifacts"]}


def test_after_a_failed_scan_the_next_good_one_works(service: ServiceProcess) -> None:
    failed = service.ended(post(service, recorded(dataset="truncated-depth")).raise_for_status().json()["id"])
    assert failed["state"] == "failed"
    assert service.ended(post(service, recorded()).raise_for_status().json()["id"])["state"] == "succeeded"
    assert service.ended(post(service, json.dumps(QUICK_SCAN).encode()).json()["id"])["state"] == "succeeded"


def test_a_file_that_was_removed_or_changed_since_is_not_handed_out(service: ServiceProcess) -> None:
    scan = service.run_quick_scan()
    folder, path = service.data / "scans" / scan["id"], f"/v1/scans/{scan['id']}/artifacts"
    (folder / "depth.png").unlink()
    (folder / "depth.npz").write_bytes(b"something else")
    (folder / "cloud.ply").unlink()
    (folder / "cloud.ply").symlink_to(service.config)
    for name in ("depth.png", "depth.npz", "cloud.ply"):
        body = problem_in(service.http.get(f"{path}/{name}"), 404, "not-found")
        assert name in body["detail"]
    assert service.http.get(f"{path}/report.json").status_code == 200
