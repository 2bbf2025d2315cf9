# SPDX-License-Identifier: GPL-3.0-or-later
"""The jobs that write clean frames: of plates (`batch`), of a capture (`capture`) and by a fit (`fitted`)."""
