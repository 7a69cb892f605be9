"""Of the requests of a page the newest wins; a page that has gone gets no work done."""

import threading

from sweeps.explore.worker import Worker

WAIT = 20  # s, on a busy machine


def test_jobs_that_have_not_begun_are_replaced():
    worker, ran = Worker("test"), []
    begun, go, done = threading.Event(), threading.Event(), threading.Event()

    def first(stale):
        begun.set()
        assert go.wait(WAIT)
        ran.append(("first", stale()))

    worker.submit("page", first)
    assert begun.wait(WAIT)
    for i in range(5):
        worker.submit("page", lambda stale, i=i: ran.append((i, stale())))
    worker.submit("other", lambda _: done.set())
    go.set()
    assert done.wait(WAIT)
    assert ran == [("first", True), (4, False)]


def test_a_dropped_key_does_no_work():
    worker, ran = Worker("test"), []
    begun, go, done = threading.Event(), threading.Event(), threading.Event()

    def first(stale):
        begun.set()
        assert go.wait(WAIT)
        ran.append(stale())
        worker.then("page", stale, lambda _: ran.append("after"))

    worker.submit("page", first)
    assert begun.wait(WAIT)
    worker.drop("page")
    worker.submit("other", lambda _: done.set())
    go.set()
    assert done.wait(WAIT)
    assert ran == [True]


def test_a_job_that_fails_ends_no_thread(capsys):
    worker, done = Worker("test"), threading.Event()
    worker.submit("page", lambda _: 1 / 0)
    worker.submit("other", lambda _: done.set(), delay=0.01)
    assert done.wait(WAIT)
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_a_delayed_job_gives_way_to_a_new_one():
    worker, ran, done = Worker("test"), [], threading.Event()
    worker.submit("page", lambda _: ran.append("late"), delay=0.2)
    worker.submit("page", lambda _: ran.append("now"))
    worker.submit("other", lambda _: done.set(), delay=0.4)
    assert done.wait(WAIT)
    assert ran == ["now"]
