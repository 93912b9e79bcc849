"""`with_one_blas_thread`."""

from threadpoolctl import threadpool_info, threadpool_limits

from rig.core.numerics.blas_threads import with_one_blas_thread


def _thread_counts() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_has_one_thread_during_the_call() -> None:
    with threadpool_limits(2, user_api="blas"):
        assert with_one_blas_thread(_thread_counts)() == {1}
        assert _thread_counts() == {2}
