"""The server reads one folder, for this machine, and lets nothing act."""

from __future__ import annotations

import http.client
import shutil
import threading

import pytest

from brainbench.core.errors import DataFileNotFoundError, UsageError
from leaderboards import build_leaderboard
from leaderboards.site.serve import make_server
from tests.factories.html_page import HOSTILE, poisoned


@pytest.fixture
def server(make_record, tmp_path):
    site = build_leaderboard(
        [poisoned(make_record(), text) for text in HOSTILE], tmp_path / "site", title="calm"
    ).parent
    (tmp_path / "secret.html").write_text("secret")
    (site / "link.html").symlink_to(tmp_path / "secret.html")
    (site / ".hidden").write_text("hidden")
    (site / "data" / "evil.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>")
    made = make_server(site, port=0)
    thread = threading.Thread(target=made.serve_forever, daemon=True)
    thread.start()
    yield made
    made.shutdown()
    made.server_close()
    thread.join()


def ask(server, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def test_it_listens_on_this_machine_alone_by_default(server):
    assert server.server_address[0] == "127.0.0.1"


def test_pages_come_with_a_policy_and_other_files_are_locked_altogether(server):
    status, headers, body = ask(server, "/")
    assert status == 200
    assert b"<title>calm" in body
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["X-Content-Type-Options"] == "nosniff"
    for path in ("/data/leaderboard.json", "/data/evil.svg"):
        status, headers, _ = ask(server, path)
        assert status == 200
        assert "sandbox" in headers["Content-Security-Policy"]
        assert "script-src" not in headers["Content-Security-Policy"]


@pytest.mark.parametrize(
    "path",
    ["/../secret.html", "/%2e%2e/secret.html", "/link.html", "/.hidden", "/models/", "/..%5csecret.html", "/nothing"],
)
def test_nothing_outside_and_nothing_hidden_is_sent(server, path):
    assert ask(server, path)[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
def test_it_is_read_only(server, method):
    assert ask(server, "/", method)[0] == 501


def test_a_foreign_name_for_this_machine_is_refused(server):
    assert ask(server, "/", Host="evil.example")[0] == 403
    assert ask(server, "/", Host="localhost")[0] == 200


def test_head_sends_no_body(server):
    status, headers, body = ask(server, "/", "HEAD")
    assert (status, body) == (200, b"")
    assert int(headers["Content-Length"]) > 1000


def test_no_site_and_a_taken_port_are_said(server, tmp_path):
    with pytest.raises(DataFileNotFoundError, match="brainbench leaderboard build"):
        make_server(tmp_path)
    with pytest.raises(UsageError, match="choose another with --port"):
        make_server(tmp_path / "site", port=server.server_address[1])
    with pytest.raises(UsageError, match="port must be 0-65535"):
        make_server(tmp_path / "site", port=99_999)


def test_loopback_has_a_sixth_version_too(server, tmp_path):
    import socket

    if not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    try:
        made = make_server(tmp_path / "site", host="::1", port=0)
    except UsageError:
        pytest.skip("no IPv6 loopback here")
    made.server_close()


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="needs the chromium browser")
def test_served_pages_work_and_nothing_hostile_runs(server):
    playwright = pytest.importorskip("playwright.sync_api")
    address = f"http://127.0.0.1:{server.server_address[1]}"
    with playwright.sync_playwright() as api:
        browser = api.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page()
        page.goto(address)
        assert page.title() == "calm"
        page.locator("#ranking tbody tr.model a").first.click()
        page.wait_for_load_state()
        assert page.title().endswith(": brainbench leaderboard")
        shouted = []
        page.on("dialog", lambda dialog: (shouted.append(dialog.message), dialog.dismiss()))
        page.goto(f"{address}/data/evil.svg")
        page.wait_for_timeout(300)
        assert shouted == []
        browser.close()
