"""Newton's method in one variable, so that the tests need no SciPy."""


def newton(f, slope, x, iterations=100):
    for _ in range(iterations):
        step = f(x) / slope(x)
        while abs(f(x - step)) > abs(f(x)) and abs(step) > 1e-300:
            step /= 2
        if abs(step) < 1e-16 * max(1.0, abs(x)):
            break
        x -= step
    return x
