# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the driver: one status about all rows of frequencies, and one per link."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from ...device.chain import LinkReport, LiveLinks
from ...device.links.link import LinkState
from ...device.scans.row_counts import RowCounts
from .updater import make_status

LEVELS = {
    LinkState.OPEN: DiagnosticStatus.OK,
    LinkState.WAITING: DiagnosticStatus.ERROR,
    LinkState.SILENT: DiagnosticStatus.STALE,
    LinkState.CLOSED: DiagnosticStatus.WARN,
}
"""State of a link (connection to a hub) -> level of its status on /diagnostics."""


class LinkDiagnostics:
    """Makes the diagnostic statuses of the node `driver`, once a second.

    There is one status about all rows (a row is one sample of one cube), and one per link
    (connection to a hub, the device that reads cubes).
    """

    def __init__(self, skin_name: str) -> None:
        self._skin_name = skin_name
        self._counts_before = RowCounts()

    def make_statuses(
        self,
        links: LiveLinks,
        with_links: bool,
    ) -> list[DiagnosticStatus]:
        """Return the diagnostic statuses of the driver.

        Args:
            links: The links to the hubs, which count rows and report their states.
            with_links: Whether the list contains a status for each link, after the status about all
                rows.
        """
        counts = links.count_rows()
        statuses = [_make_rows_status(self._skin_name, counts, self._counts_before)]
        self._counts_before = counts
        if with_links:
            statuses += [_make_link_status(report) for report in links.report()]
        return statuses


def _make_rows_status(
    skin_name: str,
    counts: RowCounts,
    before: RowCounts,
) -> DiagnosticStatus:
    """Return the status about the numbers of rows that were published and lost.

    Args:
        skin_name: Name of the skin.
        counts: Numbers of rows (samples of one cube each) since the start.
        before: The same numbers at the previous status, one second earlier.
    """
    level = DiagnosticStatus.OK
    text = ""
    if counts.unaccounted:
        level = DiagnosticStatus.ERROR
        text = f"{counts.unaccounted} rows are lost in the driver: please report it"
    # Only losses since the previous status are reported. If there are none, the level is OK again.
    elif counts.lost > before.lost:
        level = DiagnosticStatus.ERROR
        text = f"{counts.lost - before.lost} rows lost by an error: {counts.lost_reason}"
    elif counts.overload > before.overload:
        dropped = counts.overload - before.overload
        level = DiagnosticStatus.WARN
        text = (
            f"{dropped} of {dropped + counts.delivered - before.delivered} rows dropped since the "
            "last report: the host is too slow: lower the rate"
        )
    values = {
        "rows published": counts.delivered,
        "rows per second": counts.delivered - before.delivered,
        **counts.count_not_delivered(),
    }
    return make_status(
        "rows",
        skin_name,
        level,
        text,
        values,
    )


def _make_link_status(report: LinkReport) -> DiagnosticStatus:
    """Return the status of one link.

    Its level is that of the worst state that the link has had since the previous status.

    Args:
        report: State and counts of the link (connection to a hub) since the previous status.
    """
    states = (report.state, *report.past_states)
    levels = [LEVELS[state] for state in states]
    if report.notes:
        # A note, for example about damaged frames, is a warning even while the link is open.
        levels.append(DiagnosticStatus.WARN)
    uid = "" if report.hub_uid is None else f"{report.hub_uid:#x}"
    text = "; ".join(report.notes) or report.state.value
    return make_status(
        f"link {report.name}",
        uid,
        max(levels),
        text,
        report.values,
    )
