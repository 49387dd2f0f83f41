// Two arithmetics of enclosures with the same names, and derivatives over either.
//
// Interval: two doubles. The lower end is kept with its sign changed, and the processor rounds up
// during the whole run (main sets it and tests that it does): then both ends of a sum, a product, a
// quotient and a root are one operation each, rounded outwards. -frounding-math keeps the compiler from
// moving or rewriting them. Undefined, infinite or overflown: NaN in both ends, which every
// operation hands on and no comparison accepts.
//
// Exact: two fractions, equal as long as the value is rational and short; else rounded outwards to
// 512 bits. Beyond 2^±20000 it is undefined, so that no file asks for numbers without end.
#pragma once
#include "exact.hpp"

constexpr double NOT = __builtin_nan("");

// Doubles around a fraction: the whole quotient of 53 bits and the next one.
inline std::pair<double, double> doubles_around(const Fraction& x) {
    if (x.sign() == 0) return {0.0, 0.0};
    if (x.sign() < 0) {
        auto [low, high] = doubles_around(-x);
        return {-high, -low};
    }
    const long e = std::max(x.top.bits() - x.bottom.bits() - 53, -1074L);
    if (e > 1100) return {NOT, NOT};
    auto [q, r] = e >= 0 ? divide_sizes(x.top, shift(x.bottom, e)) : divide_sizes(shift(x.top, -e), x.bottom);
    long e2 = e;
    bool rest = !r.zero();
    if (q.bits() > 53) {  // 54 bits: one more goes
        rest |= q.limb[0] & 1;
        q = shift(q, -1);
        ++e2;
    }
    uint64_t value = 0;
    for (size_t i = q.limb.size(); i-- > 0;) value = (value << 32) | q.limb[i];
    const double low = std::ldexp(double(value), int(e2));
    const double high = std::ldexp(double(value + (rest ? 1 : 0)), int(e2));
    if (!std::isfinite(low) || !std::isfinite(high)) return {NOT, NOT};
    return {low, high};
}

struct Interval {
    double minus = 0, high = 0;  // minus the lower end; the upper end

    Interval() = default;
    Interval(double point) : Interval(-point, point) {}
    explicit Interval(const Fraction& x) {
        auto [l, h] = doubles_around(x);
        *this = Interval(-l, h);
    }
    explicit Interval(const Pair& p) {
        *this = Interval(-doubles_around(p.low).first, doubles_around(p.high).second);
    }
    double low() const { return -minus; }
    bool defined() const { return high == high; }
    static Interval between(double l, double h) { return Interval(-l, h); }
    static Interval undefined() {
        Interval r;
        r.minus = r.high = NOT;
        return r;
    }
    static Interval constant(const Fraction& x) { return Interval(x); }
    static Interval pi() {
        static const Interval value(FixedPoint::of(128).pi_value());
        return value;
    }
    double width() const { return high + minus; }
    double size() const { return defined() ? std::max(minus, high) : NOT; }  // the largest |x|

    static Interval ends(double minus_low, double high) {
        Interval r(minus_low, high);
        return r;
    }

private:
    Interval(double m, double h) : minus(m), high(h) {
        if (!(std::isfinite(m) && std::isfinite(h))) minus = high = NOT;
    }
};
inline Interval operator-(const Interval& a) { return Interval::ends(a.high, a.minus); }
inline Interval operator+(const Interval& a, const Interval& b) {
    return Interval::ends(a.minus + b.minus, a.high + b.high);
}
inline Interval operator-(const Interval& a, const Interval& b) { return a + (-b); }
inline Interval operator*(const Interval& a, const Interval& b) {
    if (!a.defined() || !b.defined()) return Interval::undefined();
    const double al = -a.minus, bl = -b.minus;
    // the upper ends of the four products, and of the four products of the other sign
    const double high = std::max(std::max(al * bl, al * b.high), std::max(a.high * bl, a.high * b.high));
    const double minus =
        std::max(std::max(a.minus * bl, a.minus * b.high), std::max((-a.high) * bl, (-a.high) * b.high));
    return Interval::ends(minus, high);
}
inline bool positive(const Interval& a) { return a.minus < 0; }
inline bool negative(const Interval& a) { return a.high < 0; }
inline bool not_negative(const Interval& a) { return a.minus <= 0; }
inline bool not_positive(const Interval& a) { return a.high <= 0; }
inline bool is_zero(const Interval& a) { return a.minus == 0 && a.high == 0; }
inline Interval operator/(const Interval& a, const Interval& b) {
    if (!a.defined() || !(positive(b) || negative(b))) return Interval::undefined();
    const double al = -a.minus, bl = -b.minus;
    const double high = std::max(std::max(al / bl, al / b.high), std::max(a.high / bl, a.high / b.high));
    const double minus =
        std::max(std::max(a.minus / bl, a.minus / b.high), std::max((-a.high) / bl, (-a.high) / b.high));
    return Interval::ends(minus, high);
}
inline Interval hull(const Interval& a, const Interval& b) {
    if (!a.defined() || !b.defined()) return Interval::undefined();
    return Interval::ends(std::max(a.minus, b.minus), std::max(a.high, b.high));
}
// both hold the value, so their intersection does
inline Interval meet(const Interval& a, const Interval& b) {
    if (!b.defined() || !a.defined()) return a;
    return Interval::ends(std::min(a.minus, b.minus), std::min(a.high, b.high));
}
inline Interval greater(const Interval& a, const Interval& b) {  // max(a, b)
    if (!a.defined() || !b.defined()) return Interval::undefined();
    return Interval::ends(std::min(a.minus, b.minus), std::max(a.high, b.high));
}
inline Interval power(const Interval& a, int k) {
    if (!a.defined()) return a;
    if (k % 2 == 0) {  // of |a|
        Interval size = a;
        if (negative(a)) size = -a;
        else if (!not_negative(a)) size = Interval::between(0, a.size());
        Interval r = size;
        for (int i = 1; i < k; ++i) r = r * size;
        return r;
    }
    Interval r = a;
    if (k > 1) r = power(a, k - 1) * a;
    return r;
}

constexpr long BITS = 128;

// a rising function, enclosed at each end
template <class F> Interval rising(const Interval& a, F f) {
    const Interval low = f(a.low());
    if (a.low() == a.high) return low;
    const Interval high = f(a.high);
    if (!low.defined() || !high.defined()) return Interval::undefined();
    return Interval::ends(low.minus, high.high);
}
inline Interval root(const Interval& a) {
    if (!positive(a)) return Interval::undefined();
    // rounded up; the lower end is the next double below that, unless its square is the argument
    const double low = std::sqrt(a.low());
    const double back = -((-low) * low);  // rounded down
    const bool exact = low * low == a.low() && back == a.low();
    return Interval::between(exact ? low : std::nextafter(low, 0.0), std::sqrt(a.high));
}
inline Interval exponential(const Interval& a) {
    if (!a.defined()) return a;
    return rising(a, [](double x) {
        if (x > 710) return Interval::undefined();
        if (x < -800) return Interval::between(0, 1e-300);
        return Interval(FixedPoint::of(BITS).exponential(from_double(x)));
    });
}
inline Interval logarithm(const Interval& a) {
    if (!positive(a)) return Interval::undefined();
    return rising(a, [](double x) { return Interval(FixedPoint::of(BITS).logarithm(from_double(x))); });
}
inline Pair tanh_of(const Fraction& x, long bits) {  // 1 - 2/(e^2x + 1), for x >= 0
    if (x.sign() < 0) {
        const Pair p = tanh_of(-x, bits);
        return {-p.high, -p.low};
    }
    if (x.sign() == 0) return {0, 0};
    if (x > Fraction(2000)) return {Fraction(1) - scaled(1, -2000), 1};
    if (x < scaled(1, -bits / 4)) return {x - x * x * x / Fraction(3), x};
    const Pair e = FixedPoint::of(bits).exponential(x + x);
    return {Fraction(1) - Fraction(2) / (e.low + Fraction(1)),
            Fraction(1) - Fraction(2) / (e.high + Fraction(1))};
}
inline Interval tanh_of(const Interval& a) {
    if (!a.defined()) return a;
    return rising(a, [](double x) { return Interval(tanh_of(from_double(x), BITS)); });
}
// sin(x + quarter π/2): the ends, and ±1 where a crest or a trough may lie between
inline Interval wave(const Interval& a, int quarter) {
    if (!a.defined()) return a;
    const auto at = [&](double x) {
        if (quarter == 0 && std::fabs(x) < 0x1p-40) {  // x - x³/6 .. x, so that small ones stay sharp
            const Interval p(x);
            const Interval cube = p * p * p / Interval(6.0);
            return hull(p - cube, p);
        }
        return Interval(FixedPoint::of(BITS).wave(from_double(x), quarter));
    };
    if (a.low() == a.high) return at(a.high);
    if (!(a.width() < 6) || a.size() > 1e15) return Interval::between(-1, 1);
    Interval r = hull(at(a.low()), at(a.high));
    const Interval turn = Interval::pi() + Interval::pi();
    for (const bool crest : {true, false}) {
        const double shifted = (crest ? 0.25 : 0.75) - 0.25 * quarter;
        const Interval t = a / turn - Interval(shifted);
        if (std::ceil(t.low()) <= std::floor(t.high)) r = hull(r, Interval(crest ? 1.0 : -1.0));
    }
    return r;
}

struct Exact {
    Fraction low, high;
    bool fine = true;

    Exact(double point = 0) : Exact(Fraction(int64_t(point))) {}  // small whole numbers only
    Exact(const Fraction& x) : low(x), high(x) { shorten(); }
    Exact(const Fraction& l, const Fraction& h) : low(l), high(h) { shorten(); }
    static Exact undefined() {
        Exact r;
        r.fine = false;
        return r;
    }
    static Exact constant(const Fraction& x) { return Exact(x); }
    static Exact pi() {
        const Pair p = FixedPoint::of(512).pi_value();
        return {p.low, p.high};
    }
    bool defined() const { return fine; }
    bool point() const { return fine && low == high; }

private:
    static Fraction down(const Fraction& x) {
        if (x.sign() == 0) return x;
        const long e = x.top.bits() - x.bottom.bits() - 512;
        return scaled(e >= 0 ? floor_div(x.top, shift(x.bottom, e)) : floor_div(shift(x.top, -e), x.bottom), e);
    }
    void shorten() {
        if (low.size() > 4000 || (high.size() > 1100 && !(low == high))) {
            low = down(low);
            high = -down(-high);
            if (std::max(low.size(), high.size()) > 21000) *this = undefined();
        }
    }
};
inline Exact operator-(const Exact& a) { return a.fine ? Exact(-a.high, -a.low) : a; }
inline Exact operator+(const Exact& a, const Exact& b) {
    if (!a.fine || !b.fine) return Exact::undefined();
    return a.point() && b.point() ? Exact(a.low + b.low) : Exact(a.low + b.low, a.high + b.high);
}
inline Exact operator-(const Exact& a, const Exact& b) { return a + (-b); }
inline Exact operator*(const Exact& a, const Exact& b) {
    if (!a.fine || !b.fine) return Exact::undefined();
    if (a.point() && b.point()) return Exact(a.low * b.low);
    const Fraction p[] = {a.low * b.low, a.low * b.high, a.high * b.low, a.high * b.high};
    return Exact(*std::min_element(p, p + 4), *std::max_element(p, p + 4));
}
inline bool positive(const Exact& a) { return a.fine && a.low.sign() > 0; }
inline bool negative(const Exact& a) { return a.fine && a.high.sign() < 0; }
inline bool not_negative(const Exact& a) { return a.fine && a.low.sign() >= 0; }
inline bool not_positive(const Exact& a) { return a.fine && a.high.sign() <= 0; }
inline bool is_zero(const Exact& a) { return a.fine && a.low.sign() == 0 && a.high.sign() == 0; }
inline Exact operator/(const Exact& a, const Exact& b) {
    if (!a.fine || !(positive(b) || negative(b))) return Exact::undefined();
    if (b.point()) {
        const Fraction inverse = Fraction(1) / b.low;
        return a * Exact(inverse, inverse);
    }
    return a * Exact(Fraction(1) / b.high, Fraction(1) / b.low);
}
inline Exact hull(const Exact& a, const Exact& b) {
    if (!a.fine || !b.fine) return Exact::undefined();
    return {std::min(a.low, b.low), std::max(a.high, b.high)};
}
inline Exact greater(const Exact& a, const Exact& b) {
    if (!a.fine || !b.fine) return Exact::undefined();
    return {std::max(a.low, b.low), std::max(a.high, b.high)};
}
inline Exact power(const Exact& a, int k) {
    Exact r = a;
    for (int i = 1; i < k; ++i) r = r * a;
    if (k % 2 == 0 && r.fine && r.low.sign() < 0) r.low = 0;
    return r;
}
constexpr long LONG_BITS = 512;
template <class F> Exact rising(const Exact& a, F f) {
    if (!a.fine) return a;
    const Pair low = f(a.low);
    return a.point() ? Exact(low.low, low.high) : Exact(low.low, f(a.high).high);
}
inline Exact root(const Exact& a) {
    if (!positive(a)) return Exact::undefined();
    return rising(a, [](const Fraction& x) { return FixedPoint::of(LONG_BITS).root(x); });
}
inline Exact exponential(const Exact& a) {
    if (!a.fine || a.low < Fraction(-10000) || a.high > Fraction(10000)) return Exact::undefined();
    return rising(a, [](const Fraction& x) {
        return x.sign() ? FixedPoint::of(LONG_BITS).exponential(x) : Pair{1, 1};
    });
}
inline Exact logarithm(const Exact& a) {
    if (!positive(a)) return Exact::undefined();
    return rising(a, [](const Fraction& x) {
        return x == Fraction(1) ? Pair{0, 0} : FixedPoint::of(LONG_BITS).logarithm(x);
    });
}
inline Exact tanh_of(const Exact& a) {
    return rising(a, [](const Fraction& x) { return tanh_of(x, LONG_BITS); });
}
inline Exact wave(const Exact& a, int quarter) {  // |sin x - sin y| <= |x - y|
    if (!a.fine) return a;
    const Pair p = FixedPoint::of(LONG_BITS).wave(a.low, quarter);
    const Fraction r = a.high - a.low;
    return Exact(std::max(p.low - r, Fraction(-1)), std::min(p.high + r, Fraction(1)));
}

// ---- A value with its first derivatives ----------------------------------------------------------
// Without a list of derivatives a Jet is a constant. |.| and max carry Clarke's derivatives.

template <class T> struct Jet {
    T v;
    std::vector<T> g;
    Jet(T value = T(0.0)) : v(value) {}
    Jet(T value, std::vector<T> slopes) : v(value), g(std::move(slopes)) {}
    static Jet variable(T value, size_t index, size_t count) {
        Jet r(value);
        r.g.assign(count, T(0.0));
        r.g[index] = T(1.0);
        return r;
    }
};
// value, and a.g * da + b.g * db
template <class T> Jet<T> joined(T v, const Jet<T>& a, const T& da, const Jet<T>& b, const T& db) {
    Jet<T> r(v);
    const size_t count = std::max(a.g.size(), b.g.size());
    for (size_t i = 0; i < count; ++i) {
        T s(0.0);
        if (i < a.g.size() && !is_zero(a.g[i])) s = s + a.g[i] * da;
        if (i < b.g.size() && !is_zero(b.g[i])) s = s + b.g[i] * db;
        r.g.push_back(s);
    }
    return r;
}
template <class T> Jet<T> along(T v, const Jet<T>& a, const T& da) { return joined(v, a, da, Jet<T>(), T(0.0)); }
template <class T> Jet<T> operator+(const Jet<T>& a, const Jet<T>& b) {
    return joined(a.v + b.v, a, T(1.0), b, T(1.0));
}
template <class T> Jet<T> operator-(const Jet<T>& a, const Jet<T>& b) {
    return joined(a.v - b.v, a, T(1.0), b, T(-1.0));
}
template <class T> Jet<T> operator-(const Jet<T>& a) { return along(-a.v, a, T(-1.0)); }
template <class T> Jet<T> operator*(const Jet<T>& a, const Jet<T>& b) {
    return joined(a.v * b.v, a, b.v, b, a.v);
}
template <class T> Jet<T> operator/(const Jet<T>& a, const Jet<T>& b) {
    const T q = a.v / b.v;
    return joined(q, a, T(1.0) / b.v, b, -(q / b.v));
}
template <class T> Jet<T> power(const Jet<T>& a, int k) {
    return along(power(a.v, k), a, T(double(k)) * power(a.v, k - 1));
}
template <class T> Jet<T> root(const Jet<T>& a) {
    const T r = root(a.v);
    return along(r, a, T(1.0) / (T(2.0) * r));
}
template <class T> Jet<T> wave(const Jet<T>& a, int quarter) {
    const T slope = wave(a.v, quarter == 0 ? 1 : 0);
    return along(wave(a.v, quarter), a, quarter == 0 ? slope : -slope);
}
template <class T> Jet<T> exponential(const Jet<T>& a) {
    const T r = exponential(a.v);
    return along(r, a, r);
}
template <class T> Jet<T> logarithm(const Jet<T>& a) { return along(logarithm(a.v), a, T(1.0) / a.v); }
template <class T> Jet<T> tanh_of(const Jet<T>& a) {
    const T r = tanh_of(a.v);
    return along(r, a, T(1.0) - power(r, 2));
}
template <class T> Jet<T> larger(const Jet<T>& a, const Jet<T>& b) {
    const T d = a.v - b.v;
    if (not_negative(d)) return a;
    if (not_positive(d)) return b;
    if (!d.defined()) return along(T::undefined(), a, T::undefined());
    Jet<T> r = joined(greater(a.v, b.v), a, T(0.0), b, T(0.0));
    for (size_t i = 0; i < r.g.size(); ++i)
        r.g[i] = hull(i < a.g.size() ? a.g[i] : T(0.0), i < b.g.size() ? b.g[i] : T(0.0));
    return r;
}
template <class T> Jet<T> size_of(const Jet<T>& a) { return larger(a, -a); }

// ---- Small matrices --------------------------------------------------------------------------------

template <class X> using Matrix = std::vector<std::vector<X>>;

template <class X> Matrix<X> product(const Matrix<X>& a, const Matrix<X>& b) {
    const size_t columns = b.empty() ? 0 : b[0].size();
    Matrix<X> r(a.size(), std::vector<X>(columns));
    for (size_t i = 0; i < a.size(); ++i)
        for (size_t j = 0; j < columns; ++j)
            for (size_t k = 0; k < b.size(); ++k) r[i][j] = r[i][j] + a[i][k] * b[k][j];
    return r;
}
template <class X> std::vector<X> product(const Matrix<X>& a, const std::vector<X>& x) {
    std::vector<X> r(a.size());
    for (size_t i = 0; i < a.size(); ++i)
        for (size_t k = 0; k < x.size(); ++k) r[i] = r[i] + a[i][k] * x[k];
    return r;
}
template <class X> Matrix<X> transposed(const Matrix<X>& a) {
    Matrix<X> r(a.empty() ? 0 : a[0].size(), std::vector<X>(a.size()));
    for (size_t i = 0; i < a.size(); ++i)
        for (size_t j = 0; j < a[i].size(); ++j) r[j][i] = a[i][j];
    return r;
}
template <class X> Matrix<X> sum(Matrix<X> a, const Matrix<X>& b, bool minus = false) {
    for (size_t i = 0; i < a.size(); ++i)
        for (size_t j = 0; j < a[i].size(); ++j) a[i][j] = minus ? a[i][j] - b[i][j] : a[i][j] + b[i][j];
    return a;
}
// By rows, over the sets of columns that the rows so far have used: no division. At most 11 rows.
template <class X> X determinant(const Matrix<X>& a, int without_row = -1, int without_column = -1) {
    const size_t n = a.size();
    std::map<unsigned, X> so_far{{without_column < 0 ? 0u : 1u << without_column, X(1.0)}};
    for (size_t i = 0; i < n; ++i) {
        if (int(i) == without_row) continue;
        std::map<unsigned, X> next;
        for (const auto& [used, value] : so_far)
            for (size_t j = 0; j < n; ++j) {
                if (used >> j & 1) continue;
                int later = 0;  // columns to the right that are used already: transpositions
                for (size_t k = j + 1; k < n; ++k) later += int(k) != without_column && (used >> k & 1);
                const X term = later % 2 ? -(value * a[i][j]) : value * a[i][j];
                auto [place, fresh] = next.try_emplace(used | 1u << j, term);
                if (!fresh) place->second = place->second + term;
            }
        so_far = next;
    }
    return so_far.begin()->second;
}
template <class X> Matrix<X> inverse(const Matrix<X>& a) {
    const X det = determinant(a);
    Matrix<X> r(a.size(), std::vector<X>(a.size()));
    for (size_t i = 0; i < a.size(); ++i)
        for (size_t j = 0; j < a.size(); ++j) {
            const X minor = determinant(a, int(j), int(i));
            r[i][j] = ((i + j) % 2 ? -minor : minor) / det;
        }
    return r;
}
