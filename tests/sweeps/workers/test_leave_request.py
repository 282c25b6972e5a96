"""Requests that a worker leaves: now, or soon."""

import sys
import threading

import pytest

from armscan.sweeps.workers import leave_request
from armscan.sweeps.workers.leave_request import LeaveRequest


def test_nobody_is_asked_to_leave_at_first():
    request = LeaveRequest()
    assert not request.is_now
    assert not request.is_soon


def test_who_is_asked_to_leave_soon_is_asked_to_leave_now_some_time_after_the_first_request(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(leave_request.time, "monotonic", lambda: now_s)
    request = LeaveRequest()
    request.ask_soon()
    now_s += leave_request.SOON_S - 1.0
    request.ask_soon()
    assert request.is_soon
    assert not request.is_now
    now_s += 1.0
    assert request.is_now


@pytest.mark.parametrize("first", ["ask_now", "ask_soon"])
@pytest.mark.parametrize("second", ["ask_now", "ask_soon"])
def test_a_request_can_interrupt_another_at_any_moment(first, second):
    n_interrupted = 0
    while (request := interrupted(first, second, n_interrupted)) is not None:
        assert request.is_now == ("ask_now" in (first, second))
        assert request.is_soon == ("ask_soon" in (first, second))
        n_interrupted += 1
    assert n_interrupted > 3


def interrupted(first, second, n_before):
    """Return the request after one call interrupts another after `n_before` instructions; None if it has fewer."""
    request = LeaveRequest()
    n_instructions = 0

    def interrupt(frame, *_):
        nonlocal n_instructions
        frame.f_trace_opcodes = True
        if n_instructions == n_before:
            getattr(request, second)()
        n_instructions += 1
        return interrupt

    def ask():
        # Called at each instruction, between which a signal handler may run.
        sys.settrace(interrupt)
        getattr(request, first)()

    # A deadlocked thread does not end.
    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(10.0)
    assert not thread.is_alive()
    return request if n_instructions > n_before else None
