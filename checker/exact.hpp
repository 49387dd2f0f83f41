// Whole numbers of any size, fractions of them, and elementary functions of fractions as pairs of
// fractions. Nothing here is rounded but where a function says which way.
#pragma once
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

inline double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}
inline double deadline = HUGE_VAL;  // of the claim that is decided
struct Late : std::runtime_error {  // long fractions took until then
    Late() : std::runtime_error("the time is up") {}
};

// Sign and magnitude; the limbs hold 32 bits each, the lowest first, and the last one is not 0.
struct Whole {
    std::vector<uint32_t> limb;
    bool negative = false;

    Whole() = default;
    Whole(int64_t value) : negative(value < 0) {
        uint64_t rest = value < 0 ? 0 - uint64_t(value) : uint64_t(value);
        for (; rest; rest >>= 32) limb.push_back(uint32_t(rest));
    }
    bool zero() const { return limb.empty(); }
    int sign() const { return zero() ? 0 : negative ? -1 : 1; }
    long bits() const {
        long count = 32 * long(limb.size());
        if (!zero())
            for (uint32_t top = limb.back(); !(top >> 31); top <<= 1) --count;
        return count;
    }
    void trim() {
        while (!limb.empty() && !limb.back()) limb.pop_back();
        if (limb.empty()) negative = false;
    }
    Whole operator-() const {
        Whole r = *this;
        r.negative = !zero() && !negative;
        return r;
    }
};

inline int compare_size(const Whole& a, const Whole& b) {
    if (a.limb.size() != b.limb.size()) return a.limb.size() < b.limb.size() ? -1 : 1;
    for (size_t i = a.limb.size(); i-- > 0;)
        if (a.limb[i] != b.limb[i]) return a.limb[i] < b.limb[i] ? -1 : 1;
    return 0;
}

inline Whole operator+(const Whole& a, const Whole& b) {
    Whole r;
    if (a.negative == b.negative || a.zero() || b.zero()) {
        const Whole &x = a.limb.size() < b.limb.size() ? b : a, &y = &x == &a ? b : a;
        r.limb.reserve(x.limb.size() + 1);
        uint64_t carry = 0;
        for (size_t i = 0; i < x.limb.size(); ++i) {
            carry += uint64_t(x.limb[i]) + (i < y.limb.size() ? y.limb[i] : 0);
            r.limb.push_back(uint32_t(carry));
            carry >>= 32;
        }
        if (carry) r.limb.push_back(uint32_t(carry));
        r.negative = a.zero() ? b.negative : a.negative;
        return r;
    }
    const int order = compare_size(a, b);
    if (order == 0) return r;
    const Whole &x = order > 0 ? a : b, &y = order > 0 ? b : a;
    int64_t borrow = 0;
    for (size_t i = 0; i < x.limb.size(); ++i) {
        int64_t d = int64_t(x.limb[i]) - (i < y.limb.size() ? int64_t(y.limb[i]) : 0) + borrow;
        borrow = d < 0 ? -1 : 0;
        r.limb.push_back(uint32_t(d));
    }
    r.negative = x.negative;
    r.trim();
    return r;
}
inline Whole operator-(const Whole& a, const Whole& b) { return a + (-b); }

inline Whole operator*(const Whole& a, const Whole& b) {
    Whole r;
    if (a.zero() || b.zero()) return r;
    r.limb.assign(a.limb.size() + b.limb.size(), 0);
    for (size_t i = 0; i < a.limb.size(); ++i) {
        uint64_t carry = 0;
        for (size_t j = 0; j < b.limb.size(); ++j) {
            carry += uint64_t(a.limb[i]) * b.limb[j] + r.limb[i + j];
            r.limb[i + j] = uint32_t(carry);
            carry >>= 32;
        }
        r.limb[i + b.limb.size()] = uint32_t(carry);
    }
    r.negative = a.negative != b.negative;
    r.trim();
    return r;
}

// a · 2^by for by >= 0; for by < 0 the quotient rounded down (towards minus infinity).
inline Whole shift(const Whole& a, long by) {
    if (a.zero() || by == 0) return a;
    Whole r;
    r.negative = a.negative;
    const size_t limbs = size_t(std::labs(by)) / 32, rest = size_t(std::labs(by)) % 32;
    if (by > 0) {
        r.limb.assign(limbs, 0);
        uint32_t carry = 0;
        for (uint32_t x : a.limb) {
            r.limb.push_back(rest ? (x << rest) | carry : x);
            carry = rest ? x >> (32 - rest) : 0;
        }
        if (carry) r.limb.push_back(carry);
        return r;
    }
    bool lost = false;
    for (size_t i = 0; i < std::min(limbs, a.limb.size()); ++i) lost |= a.limb[i] != 0;
    for (size_t i = limbs; i < a.limb.size(); ++i) {
        const uint32_t high = i + 1 < a.limb.size() ? a.limb[i + 1] : 0;
        if (i == limbs && rest) lost |= (a.limb[i] << (32 - rest)) != 0;
        r.limb.push_back(rest ? (a.limb[i] >> rest) | (high << (32 - rest)) : a.limb[i]);
    }
    r.trim();
    return a.negative && lost ? r - Whole(1) : r;
}

// Quotient and remainder of the magnitudes (Knuth, volume 2, algorithm D).
inline std::pair<Whole, Whole> divide_sizes(Whole a, Whole b) {
    if (b.zero()) throw std::logic_error("division by zero");
    a.negative = b.negative = false;
    if (compare_size(a, b) < 0) return {Whole(), a};
    Whole q;
    if (b.limb.size() == 1) {
        uint64_t rest = 0;
        q.limb.assign(a.limb.size(), 0);
        for (size_t i = a.limb.size(); i-- > 0;) {
            rest = (rest << 32) | a.limb[i];
            q.limb[i] = uint32_t(rest / b.limb[0]);
            rest %= b.limb[0];
        }
        q.trim();
        return {q, Whole(int64_t(rest))};
    }
    const long scale = 32 * long(b.limb.size()) - b.bits();
    a = shift(a, scale);
    b = shift(b, scale);
    const size_t n = b.limb.size();
    a.limb.push_back(0);
    if (a.limb.size() == n) a.limb.push_back(0);
    const size_t m = a.limb.size() - n;
    q.limb.assign(m, 0);
    for (size_t j = m; j-- > 0;) {
        const uint64_t top = (uint64_t(a.limb[j + n]) << 32) | a.limb[j + n - 1];
        uint64_t guess = top / b.limb[n - 1], rest = top % b.limb[n - 1];
        while (guess >> 32 || guess * b.limb[n - 2] > ((rest << 32) | a.limb[j + n - 2])) {
            --guess;
            rest += b.limb[n - 1];
            if (rest >> 32) break;
        }
        int64_t borrow = 0;
        uint64_t carry = 0;
        for (size_t i = 0; i < n; ++i) {
            carry += guess * b.limb[i];
            const int64_t d = int64_t(a.limb[i + j]) - int64_t(uint32_t(carry)) + borrow;
            a.limb[i + j] = uint32_t(d);
            borrow = d < 0 ? -1 : 0;
            carry >>= 32;
        }
        const int64_t d = int64_t(a.limb[j + n]) - int64_t(carry) + borrow;
        a.limb[j + n] = uint32_t(d);
        if (d < 0) {
            --guess;
            uint64_t back = 0;
            for (size_t i = 0; i < n; ++i) {
                back += uint64_t(a.limb[i + j]) + b.limb[i];
                a.limb[i + j] = uint32_t(back);
                back >>= 32;
            }
            a.limb[j + n] += uint32_t(back);
        }
        q.limb[j] = uint32_t(guess);
    }
    q.trim();
    a.trim();
    return {q, shift(a, -scale)};
}

// a / b rounded down, b > 0.
inline Whole floor_div(const Whole& a, const Whole& b) {
    auto [q, r] = divide_sizes(a, b);
    if (!a.negative) return q;
    return r.zero() ? -q : -(q + Whole(1));
}
inline Whole ceil_div(const Whole& a, const Whole& b) { return -floor_div(-a, b); }

inline std::string decimal(const Whole& a) {
    std::string text;
    const Whole chunk(1000000000);
    Whole rest = a;
    rest.negative = false;
    while (!rest.zero()) {
        auto [q, r] = divide_sizes(rest, chunk);
        std::string part = std::to_string(r.zero() ? 0 : r.limb[0]);
        text = (q.zero() ? part : std::string(9 - part.size(), '0') + part) + text;
        rest = q;
    }
    return text.empty() ? "0" : a.negative ? "-" + text : text;
}

struct Fraction {
    Whole top, bottom = 1;  // bottom > 0, reduced
    Fraction(int64_t value = 0) : top(value) {}
    Fraction(Whole numerator, Whole denominator) : top(numerator), bottom(denominator) {
        if (bottom.sign() <= 0) throw std::logic_error("denominator");
        if (bottom.limb.size() > 32 && now() > deadline) throw Late();
        Whole a = top, b = bottom;
        a.negative = false;
        while (!b.zero()) {
            Whole r = divide_sizes(a, b).second;
            a = b;
            b = r;
        }
        if (a.bits() > 1) {
            const bool negative = top.negative;
            top = divide_sizes(top, a).first;
            top.negative = negative && !top.zero();
            bottom = divide_sizes(bottom, a).first;
        }
    }
    int sign() const { return top.sign(); }
    long size() const { return top.bits() + bottom.bits(); }
};
inline Fraction operator-(const Fraction& a) {
    Fraction r = a;
    r.top = -r.top;
    return r;
}
inline Fraction operator+(const Fraction& a, const Fraction& b) {
    return {a.top * b.bottom + b.top * a.bottom, a.bottom * b.bottom};
}
inline Fraction operator-(const Fraction& a, const Fraction& b) { return a + (-b); }
inline Fraction operator*(const Fraction& a, const Fraction& b) {
    return {a.top * b.top, a.bottom * b.bottom};
}
inline Fraction operator/(const Fraction& a, const Fraction& b) {
    if (b.sign() == 0) throw std::logic_error("division by zero");
    return b.sign() > 0 ? Fraction(a.top * b.bottom, a.bottom * b.top)
                        : Fraction(-(a.top * b.bottom), -(a.bottom * b.top));
}
inline int compare(const Fraction& a, const Fraction& b) {
    return (a.top * b.bottom - b.top * a.bottom).sign();
}
inline bool operator<(const Fraction& a, const Fraction& b) { return compare(a, b) < 0; }
inline bool operator<=(const Fraction& a, const Fraction& b) { return compare(a, b) <= 0; }
inline bool operator>(const Fraction& a, const Fraction& b) { return compare(a, b) > 0; }
inline bool operator>=(const Fraction& a, const Fraction& b) { return compare(a, b) >= 0; }
inline bool operator==(const Fraction& a, const Fraction& b) { return compare(a, b) == 0; }

// top · 2^exponent
inline Fraction scaled(const Whole& top, long exponent) {
    if (exponent >= 0) return Fraction(shift(top, exponent), 1);
    long twos = 0;  // reduced by counting the zeros at the end: no common divisor is to be looked for
    if (!top.zero()) {
        while (!top.limb[size_t(twos) / 32]) twos += 32;
        while (!((top.limb[size_t(twos) / 32] >> (twos % 32)) & 1)) ++twos;
    }
    twos = top.zero() ? -exponent : std::min(twos, -exponent);
    Fraction r;
    r.top = shift(top, -twos);
    r.bottom = shift(1, -exponent - twos);
    return r;
}
inline Fraction from_double(double value) {
    int exponent;
    const double m = std::frexp(value, &exponent);
    return scaled(Whole(int64_t(std::ldexp(m, 53))), exponent - 53);
}

// ---- Enclosures of elementary functions of one fraction ------------------------------------------
// Fixed point: [low, high] · 2^-P, products and quotients rounded outwards, so that every error of a
// Taylor sum is in the pair; the remainder is added at the end.

struct Pair {
    Fraction low, high;
};

struct Fixed {
    Whole low, high;
};

class FixedPoint {
    const long P;
    const Whole one;

    Fixed add(const Fixed& a, const Fixed& b) const { return {a.low + b.low, a.high + b.high}; }
    Fixed sub(const Fixed& a, const Fixed& b) const { return {a.low - b.high, a.high - b.low}; }
    Fixed mul(const Fixed& a, const Fixed& b) const {
        Whole least, most;
        bool first = true;
        for (const Whole* x : {&a.low, &a.high})
            for (const Whole* y : {&b.low, &b.high}) {
                Whole p = *x * *y;
                if (first || (p - least).sign() < 0) least = p;
                if (first || (p - most).sign() > 0) most = p;
                first = false;
            }
        return {shift(least, -P), -shift(-most, -P)};
    }
    Fixed over(const Fixed& a, int64_t k) const { return {floor_div(a.low, k), ceil_div(a.high, k)}; }
    Fixed number(const Fraction& x) const {
        const Whole t = shift(x.top, P);
        return {floor_div(t, x.bottom), ceil_div(t, x.bottom)};
    }
    Fixed widened(const Fixed& a, const Whole& by) const { return {a.low - by, a.high + by}; }
    Pair pair(const Fixed& a, long exponent = 0) const {
        return {scaled(a.low, exponent - P), scaled(a.high, exponent - P)};
    }
    bool small(const Fixed& a) const { return a.low.bits() <= 2 && a.high.bits() <= 2; }

    // atan(1/k), k >= 2, an alternating series with falling terms: the rest is below the next term.
    Fixed atan_inverse(int64_t k) const {
        Fixed power = over({one, one}, k), sum = power;
        for (int64_t j = 3;; j += 2) {
            power = over(power, k * k);
            const Fixed term = over(power, j);
            if (small(term)) return widened(sum, 4);
            sum = j % 4 == 3 ? sub(sum, term) : add(sum, term);
        }
    }
    // 2 atanh(x) = 2 Σ x^(2j+1)/(2j+1) for 0 <= x <= 1/3: the rest is below 9/8 of the next term.
    Fixed two_atanh(const Fixed& x) const {
        const Fixed square = mul(x, x);
        Fixed power = x, sum = x;
        for (int64_t j = 3;; j += 2) {
            power = mul(power, square);
            const Fixed term = over(power, j);
            if (small(term)) return widened(add(sum, sum), 16);
            sum = add(sum, term);
        }
    }
    // Machin's formula
    Fixed pi() const {
        const Fixed a = atan_inverse(5), b = atan_inverse(239);
        return {Whole(16) * a.low - Whole(4) * b.high, Whole(16) * a.high - Whole(4) * b.low};
    }
    Fixed log2() const { return two_atanh(over({one, one}, 3)); }
    // Σ ± x^(2j+first)/(2j+first)! for |x| < 1: after a term the rest is below the next one, in size.
    Fixed alternating(const Fixed& x, int first) const {
        const Fixed square = mul(x, x);
        Fixed term = first ? x : Fixed{one, one}, sum = term;
        for (int64_t j = first + 2;; j += 2) {
            term = over(mul(term, square), (j - 1) * j);
            if (small(term)) return widened(sum, 4);
            sum = (j - first) % 4 == 2 ? sub(sum, term) : add(sum, term);
        }
    }
    static const FixedPoint& finer(long P) {
        static std::map<long, FixedPoint> made;
        return made.try_emplace(P, P).first->second;
    }
    const Fixed& constant(bool circle) const {
        static std::map<std::pair<long, bool>, Fixed> made;
        auto found = made.find({P, circle});
        if (found == made.end())
            found = made.emplace(std::make_pair(P, circle), circle ? pi() : log2()).first;
        return found->second;
    }

public:
    explicit FixedPoint(long bits) : P(bits), one(shift(1, bits)) {}
    static const FixedPoint& of(long P) { return finer(P); }

    Pair pi_value() const { return pair(constant(true)); }

    // sin (quarter = 0) or cos (quarter = 1), for any x: x = r + k π/2 with |r| < 1.
    Pair wave(const Fraction& x, int quarter) const {
        if (x.sign() == 0) return {quarter, quarter};
        const long size = std::max(0L, x.top.bits() - x.bottom.bits() + 1);
        if (size > 64) return {-1, 1};
        if (size > 1 && P < 400) return finer(P + 72).wave_reduced(x, quarter);
        return wave_reduced(x, quarter);
    }
    Pair exponential(const Fraction& x) const {  // |x| < 2^20
        const Fixed value = number(x), step = constant(false);
        const Whole k = floor_div(value.low, step.low);
        const Fixed r = sub(value, mul({k * one, k * one}, step));
        Fixed term{one, one}, sum = term;
        for (int64_t j = 1;; ++j) {
            term = over(mul(term, r), j);
            if (j > 4 && small(term)) break;  // the rest is below (3/4)/5 + … of this term, j > 4
            sum = add(sum, term);
        }
        const long exponent = k.zero() ? 0 : long(k.limb[0]) * k.sign();
        return pair(widened(sum, 8), exponent);
    }
    Pair logarithm(const Fraction& x) const {  // x > 0
        const long e = x.top.bits() - x.bottom.bits();  // 2^(e-1) < x < 2^(e+1)
        const Fraction m = x * scaled(1, -(e - 1));     // 1 < m < 4
        const long half = m >= Fraction(2) ? 1 : 0;
        const Fraction r = half ? m * Fraction(Whole(1), Whole(2)) : m;  // 1 <= r < 2
        const Fixed s = two_atanh(number((r - Fraction(1)) / (r + Fraction(1))));
        const Whole k(e - 1 + half);
        return pair(add(s, mul({k * one, k * one}, constant(false))));
    }
    Pair root(const Fraction& x) const {  // x >= 0; exact for squares of fractions
        const long up = std::max(0L, 2 * P - x.top.bits() + x.bottom.bits());
        Whole a = square_root(x.top), b = square_root(x.bottom);
        if ((a * a - x.top).zero() && (b * b - x.bottom).zero()) return {{a, b}, {a, b}};
        const long even = up + (up & 1);
        const Whole r = square_root(floor_div(shift(x.top, even), x.bottom));
        return {scaled(r, -even / 2), scaled(r + Whole(1), -even / 2)};
    }

private:
    Pair wave_reduced(const Fraction& x, int quarter) const {
        const Fixed value = number(x), whole = constant(true);
        // any k will do; this one makes |r| <= π/4 and a little
        const Whole k = floor_div(shift(value.low, 1) + shift(whole.low, -1), whole.low);
        const Fixed turns = mul({k * one, k * one}, whole);
        const Fixed r = sub(value, {shift(turns.low, -1), -shift(-turns.high, -1)});
        const Whole limit = one - shift(one, -3);
        if ((r.high - limit).sign() > 0 || (r.low + limit).sign() < 0) return {-1, 1};
        const int which = int(((k.zero() ? 0 : (k.limb[0] & 3)) * (k.negative ? 3 : 1) + quarter) & 3);
        Fixed s = alternating(r, which % 2 == 0);
        if (which >= 2) s = {-s.high, -s.low};
        Pair p = pair(s);
        if (p.low < Fraction(-1)) p.low = -1;
        if (p.high > Fraction(1)) p.high = 1;
        return p;
    }
    static Whole square_root(const Whole& a) {  // rounded down (Newton from above)
        if (a.zero()) return a;
        Whole x = shift(1, a.bits() / 2 + 1);
        for (;;) {
            const Whole y = shift(x + floor_div(a, x), -1);
            if ((y - x).sign() >= 0) return x;
            x = y;
        }
    }
};
